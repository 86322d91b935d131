//! `bom`: command line of the project.
fn main() {}
