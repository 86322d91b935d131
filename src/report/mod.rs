//! The posterior for people and for other programs: the table on the terminal, csv files, HTML.

mod chart;
pub mod displacement_csv;
pub mod evaluation;
mod found;
pub mod html;
pub mod series;
pub mod table;
mod tree_picture;
