//! The posterior for people and for other programs: the table on the terminal, csv files.

pub mod displacement_csv;
pub mod table;
