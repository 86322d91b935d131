//! `observations.csv` and `predictions.csv`: where each part was seen, and where it was expected.
//!
//! A row is a displacement D of a part since the first frame, in world: its point p of the first
//! frame is at D·p. std is the spread of D·c, c the part's centre held fixed.

use std::io::{self, Write};

use nalgebra::{Matrix6, Vector3, Vector6};

use crate::math::Pose;
use crate::types::Label;

/// Where a part may be that was not seen at all: turned anyhow \[rad\], within this reach \[m\].
const UNSEEN_STD: (f64, f64) = (std::f64::consts::PI, 1.0);

/// One row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Stamp since time zero \[s\].
    pub time_s: f64,
    /// How far ahead of the stamp; `None` for what was seen \[s\].
    pub horizon_s: Option<f64>,
    /// The part.
    pub label: Label,
    /// D.
    pub displacement: Pose,
    /// Spread of D·c along the world's axes \[m\].
    pub std_m: Vector3<f64>,
}

/// Writes the header; `with_horizon` for predictions.
///
/// # Errors
/// As the writer.
pub fn write_header(mut to: impl Write, with_horizon: bool) -> io::Result<()> {
    let horizon = if with_horizon { "horizon_s," } else { "" };
    writeln!(to, "t_s,{horizon}label,x_m,y_m,z_m,qx,qy,qz,qw,std_x_m,std_y_m,std_z_m")
}

/// Writes a row.
///
/// # Errors
/// As the writer; a number that is not finite, by time and part.
pub fn write_row(mut to: impl Write, row: &Row) -> io::Result<()> {
    let x = row.displacement.translation;
    let q = row.displacement.quaternion();
    let numbers = [x.x, x.y, x.z, q.i, q.j, q.k, q.w, row.std_m.x, row.std_m.y, row.std_m.z];
    if !numbers.iter().all(|number| number.is_finite()) {
        let place = format!("{:.3} s, part {}: {numbers:?}, expected finite numbers", row.time_s, row.label);
        return Err(io::Error::new(io::ErrorKind::InvalidData, place));
    }
    write!(to, "{:.9},", row.time_s)?;
    if let Some(horizon_s) = row.horizon_s {
        write!(to, "{horizon_s},")?;
    }
    write!(to, "{}", row.label)?;
    for number in &numbers[..7] {
        write!(to, ",{number:.9}")?;
    }
    for number in &numbers[7..] {
        write!(to, ",{number:.6}")?;
    }
    writeln!(to)
}

/// Spread along the world's axes of the point c that the information is centred on: ξ in
/// `truth = D · T(c) · exp(ξ) · T(−c)` moves D·c by R ξ_linear.
pub fn center_std(displacement: &Pose, information: &Matrix6<f64>) -> Vector3<f64> {
    let (angle, reach) = UNSEEN_STD;
    let unseen = Vector6::new(angle, angle, angle, reach, reach, reach).map(|std| std.powi(-2));
    let unknown = Vector3::repeat(reach);
    let Some(cholesky) = (information + Matrix6::from_diagonal(&unseen)).cholesky() else { return unknown };
    let linear = cholesky.inverse().fixed_view::<3, 3>(3, 3).into_owned();
    (displacement.rotation * linear * displacement.rotation.transpose())
        .diagonal()
        .map(|variance| variance.max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    fn quarter_about_z() -> Pose {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        Pose::from_quaternion(&turn, Vector3::new(1.0, -2.0, 0.5))
    }

    #[test]
    fn rows_have_the_columns_of_their_header() {
        let row = Row {
            time_s: 0.1,
            horizon_s: Some(0.5),
            label: Label(4),
            displacement: quarter_about_z(),
            std_m: Vector3::new(0.001, 0.002, 0.25),
        };
        let mut text = Vec::new();
        write_header(&mut text, true).unwrap();
        write_row(&mut text, &row).unwrap();
        let expected = "t_s,horizon_s,label,x_m,y_m,z_m,qx,qy,qz,qw,std_x_m,std_y_m,std_z_m\n\
            0.100000000,0.5,4,1.000000000,-2.000000000,0.500000000,\
            0.000000000,0.000000000,0.707106781,0.707106781,0.001000,0.002000,0.250000\n";
        assert_eq!(String::from_utf8(text).unwrap(), expected);
        let nan = Row { std_m: Vector3::repeat(f64::NAN), ..row };
        assert!(write_row(io::sink(), &nan).unwrap_err().to_string().starts_with("0.100 s, part 4: "));
    }

    #[test]
    fn spread_turns_with_the_part_and_is_bounded_where_nothing_was_seen() {
        // Held along its own x to 1 mm and y to 10 mm: turned by a quarter, these are y and x.
        let held = Matrix6::from_diagonal(&Vector6::new(1e6, 1e6, 1e6, 1e6, 1e4, 0.0));
        let std = center_std(&quarter_about_z(), &held);
        assert!((std - Vector3::new(0.01, 0.001, 1.0)).norm() < 1e-5, "{std}");
        assert_eq!(center_std(&Pose::identity(), &Matrix6::zeros()), Vector3::repeat(1.0));
    }
}
