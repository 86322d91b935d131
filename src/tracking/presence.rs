//! Which of several accounts of a part's place the clouds bear out.
//!
//! Each account's pose is charged the mean truncated cost of the scan there, beyond what the part costs
//! where its pose is known, smoothed over frames: P(account) ∝ prior · exp(−N · excess). Poses are not
//! registered for this, so that nothing slides to where it fits.

use crate::math::{Pose, softmax};
use crate::registration::{PartModel, ScanPoint, thinned_cost};

/// Independent points that they are worth: neighbours share their errors.
pub const INDEPENDENT: f64 = 20.0;
/// Share of the newest frame in the smoothed excess.
const NEWEST: f64 = 0.4;
/// Excess beyond which no account holds.
const LOST: f64 = 0.6;

/// What an account that is lost loses beside its excess: costs are truncated, and all lost poses alike.
const LOG_LOST: f64 = -6.0;

/// What may say where a part is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Account {
    /// The filter, by its joint.
    Joint,
    /// It rests where it was last known to be.
    Place,
    /// Registration from frame to frame.
    Scan,
}

impl Account {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Joint, Self::Place, Self::Scan];

    /// Registration fits each frame anew, and so always costs a little less: it must gain more.
    fn log_prior(self) -> f64 {
        match self {
            Self::Joint => 0.0,
            Self::Place => -1.0,
            Self::Scan => -8.0,
        }
    }
}

/// Smoothed excess of the accounts of one part.
#[derive(Clone, Debug, Default)]
pub struct Presence {
    excess: [Option<f64>; 3],
}

impl Presence {
    /// Charges the accounts' poses with a scan; `usual` is what the part costs at a known pose.
    pub fn see(&mut self, model: &PartModel, scan: &[ScanPoint], usual: f64, poses: [Option<Pose>; 3]) {
        for (excess, pose) in self.excess.iter_mut().zip(poses) {
            let Some(pose) = pose else {
                *excess = None;
                continue;
            };
            let now = (thinned_cost(model, scan, &pose) - usual).max(0.0);
            *excess = Some(excess.map_or(now, |before| before + NEWEST * (now - before)));
        }
    }

    /// Forgets what was held against an account: its pose has changed.
    pub fn clear(&mut self, account: Account) {
        self.excess[account as usize] = None;
    }

    /// Smoothed excess of an account.
    pub fn excess(&self, account: Account) -> Option<f64> {
        self.excess[account as usize]
    }

    /// Whether an account's pose is far from explaining the scans.
    pub fn is_lost(&self, account: Account) -> bool {
        self.excess(account).is_some_and(|excess| excess > LOST)
    }

    /// Probability of each account among those that `there` are.
    pub fn weights(&self, there: [bool; 3]) -> [f64; 3] {
        let logs = Account::ALL.map(|account| {
            let lost = if self.is_lost(account) { LOG_LOST } else { 0.0 };
            let own = account.log_prior() + lost - INDEPENDENT * self.excess(account).unwrap_or(0.0);
            if there[account as usize] { own } else { f64::NEG_INFINITY }
        });
        if there == [false; 3] {
            return [0.0; 3];
        }
        let weights = softmax(logs.into_iter());
        std::array::from_fn(|account| weights[account])
    }
}
