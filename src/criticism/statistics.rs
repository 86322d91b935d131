//! p-values of whiteness.

/// P(χ² with `freedom` degrees > `x`), by the cube-root normal approximation (Wilson, Hilferty 1931).
pub fn chi_squared_tail(x: f64, freedom: f64) -> f64 {
    if x <= 0.0 || freedom <= 0.0 {
        return 1.0;
    }
    let spread = 2.0 / (9.0 * freedom);
    let z = ((x / freedom).cbrt() - 1.0 + spread) / spread.sqrt();
    0.5 * libm::erfc(z / std::f64::consts::SQRT_2)
}

/// p-value of a series being white: Ljung, Box 1978, over `lags` lags, of series kept apart.
pub fn whiteness(series: &[Vec<f64>], lags: usize) -> f64 {
    let count: usize = series.iter().map(Vec::len).sum();
    let squares: f64 = series.iter().flatten().map(|e| e * e).sum();
    if count <= lags + 1 || squares <= 0.0 {
        return 1.0;
    }
    let n = count as f64;
    let statistic: f64 = (1..=lags)
        .map(|lag| {
            let sum: f64 = series.iter().flat_map(|s| s.iter().zip(s.iter().skip(lag))).map(|(a, b)| a * b).sum();
            (sum / squares).powi(2) / (n - lag as f64)
        })
        .sum();
    chi_squared_tail(n * (n + 2.0) * statistic, lags as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tails_are_those_of_the_tables() {
        for (x, freedom, p) in [(18.307, 10.0, 0.05), (23.209, 10.0, 0.01), (9.342, 10.0, 0.5), (3.841, 1.0, 0.05)] {
            assert!((chi_squared_tail(x, freedom) - p).abs() < 0.004, "{x} {freedom}");
        }
    }

    #[test]
    fn a_slow_wave_is_not_white() {
        let wave: Vec<f64> = (0..80).map(|i| (f64::from(i) * 0.2).sin()).collect();
        assert!(whiteness(&[wave], 10) < 1e-6);
        // A full-period linear congruential sequence: white enough.
        let mut state = 1_u32;
        let noise: Vec<f64> = (0..400)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                f64::from(state >> 8) / f64::from(1 << 24) - 0.5
            })
            .collect();
        assert!(whiteness(&[noise], 10) > 0.01);
    }
}
