//! How well each way to predict did of late, and so how far it is to be believed.
//!
//! The errors of a way to predict are normal with unknown variance: with an inverse-gamma prior (a, b)
//! their marginal density is ∝ (b + ½ Σ ω e²)^−(a + ½ Σ ω), ω fading (Student-t). P(way) ∝ prior ·
//! that, and b' / (a' − 1) is the variance that the way has shown.

use crate::math::softmax;

/// Ways to predict.
pub const WAYS: usize = 3;
/// The simulated mechanism; its rates, fading; rest.
const PRIORS: [f64; WAYS] = [0.9, 0.05, 0.05];
/// A past error counts this much less with each new frame.
const FADING: f64 = 0.8;
/// a, for errors of three numbers.
const SHAPE: f64 = 1.5;

/// The record of one part at one horizon.
#[derive(Clone, Copy, Debug, Default)]
pub struct Skill {
    squares: [f64; WAYS],
    count: f64,
}

impl Skill {
    /// Takes in the errors of all ways \[m\].
    pub fn learn(&mut self, errors_m: [f64; WAYS]) {
        for (sum, error) in self.squares.iter_mut().zip(errors_m) {
            *sum = FADING * *sum + error * error;
        }
        self.count = FADING * self.count + 1.0;
    }

    /// Forgets a little, where nothing was to be learned.
    pub fn fade(&mut self) {
        self.squares.iter_mut().for_each(|sum| *sum *= FADING);
        self.count *= FADING;
    }

    /// Probability of each way and the variance that it has shown \[m²\], errors below `usual_m` \[m\]
    /// being no fault.
    pub fn weights(&self, usual_m: f64) -> [(f64, f64); WAYS] {
        let shape = SHAPE + 0.5 * self.count;
        let scale = |way: usize| SHAPE * usual_m * usual_m + 0.5 * self.squares[way];
        let logs = (0..WAYS).map(|way| PRIORS[way].ln() - shape * scale(way).ln());
        let shares = softmax(logs);
        std::array::from_fn(|way| (shares[way], scale(way) / (shape - 1.0).max(0.5)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_fails_is_left_for_what_holds() {
        let mut skill = Skill::default();
        assert!((skill.weights(0.01)[0].0 - 0.9).abs() < 1e-12);
        for _ in 0..5 {
            skill.learn([0.2, 0.1, 0.002]);
        }
        let weights = skill.weights(0.01);
        assert!(weights[2].0 > 0.99, "{weights:?}");
        for _ in 0..20 {
            skill.learn([0.002, 0.1, 0.2]);
        }
        assert!(skill.weights(0.01)[0].0 > 0.99);
        for _ in 0..60 {
            skill.fade();
        }
        assert!((skill.weights(0.01)[0].0 - 0.9).abs() < 1e-3);
    }
}
