//! What stays of old windows: memory and time per window do not grow with the stream.
//!
//! At most so many windows are kept in full, those that say most of the axes. Of a window that goes:
//! - its site in the dynamics is multiplied onto those of the windows gone before it: nothing is lost
//!   but the chance to fit it again;
//! - what it added to the evidence of every parent and type stays added;
//! - the model keeps what it saw, where the last fit had it;
//! - of the axes nothing is kept: frames at one pose share a registration error, so that what a pose
//!   says of an axis is bounded however often it is seen, and a Gaussian of it multiplied with the next
//!   look at the same pose would count that error as if it were two.

use std::collections::BTreeSet;

use super::Learner;
use super::explain::travel;
use super::learner::{MOVED, WindowJob};
use crate::math::Pose;
use crate::types::Label;
use crate::types::posterior::WindowRecord;

impl Learner {
    /// Enters the newest window into the list that is published.
    pub(super) fn record(&mut self, job: &WindowJob) {
        let inference = self.inferences.last();
        let learned = inference.filter(|inference| inference.failure.is_none() && inference.steps > 0);
        let end = |time: Option<f64>| time.unwrap_or_default();
        let mut labels: BTreeSet<Label> = job.contacts.iter().map(|contact| contact.label).collect();
        labels.extend(job.wrenches.iter().filter(|wrench| !wrench.tool).filter_map(|wrench| wrench.part));
        self.records.push(WindowRecord {
            t0_s: end(job.frames.first().map(|frame| frame.time_s)),
            t1_s: end(job.frames.last().map(|frame| frame.time_s)),
            labels: labels.into_iter().collect(),
            frames: job.frames.len(),
            steps: inference.map_or(0, |inference| inference.steps),
            inference_wall_s: 0.0,
            elbo: learned.map(|inference| inference.elbo),
            log_predictive_density: learned.map(|inference| inference.log_predictive_density),
        });
    }

    /// Lets windows go until no more are left than are to be kept.
    pub(super) fn retire(&mut self) {
        while self.windows.len() > self.kept_windows.max(1) {
            let Some(window) = self.least_informative() else { return };
            self.retire_window(window);
        }
    }

    /// The window whose loss costs the axes least; the newest stays.
    fn least_informative(&self) -> Option<usize> {
        let older = self.windows.len().checked_sub(1)?;
        let information = self.fit.as_ref().map_or(&[][..], |fit| &fit.window_information);
        let of = |window: &usize| information.get(*window).copied().unwrap_or(0.0);
        (0..older).min_by(|a, b| of(a).total_cmp(&of(b)))
    }

    fn retire_window(&mut self, window: usize) {
        if let Some(fit) = &self.fit {
            self.dynamics.retire(window, fit);
        }
        for option in self.evidence.values_mut().flatten() {
            let added = option.of_window(window);
            for (past, added) in option.past.iter_mut().zip(added) {
                *past += added;
            }
            drop_at(&mut option.rigid_by_window, window);
            for fit in option.fits.iter_mut().flatten() {
                // The type's evidence is `past` and this: what moves over to the one leaves the other.
                let own = if window < fit.by_window.len() { fit.by_window.remove(window) } else { 0.0 };
                fit.log_evidence -= own;
                drop_at(&mut fit.positions, window);
            }
        }
        for (label, tracks) in &mut self.tracks {
            if window >= tracks.len() {
                continue;
            }
            let track = tracks.remove(window);
            if let Some(keyframes) = self.keyframes.get_mut(label) {
                keyframes.retire(window, &track);
            }
            let moved = |model| track.iter().any(|d| travel(model, &Pose::identity(), d) > MOVED);
            if self.models.get(label).is_some_and(moved) {
                self.moved_before.insert(*label);
            }
        }
        if let Some(fit) = &mut self.fit {
            // A fit that failed leaves the one before, which may not know the newest window.
            drop_at(&mut fit.positions, window);
            drop_at(&mut fit.contact_points, window);
            drop_at(&mut fit.window_costs, window);
            drop_at(&mut fit.window_information, window);
            fit.moves.iter_mut().for_each(|moves| drop_at(moves, window));
        }
        drop_at(&mut self.kept, window);
        self.measured_at.values_mut().for_each(|measured| drop_at(measured, window));
        self.weighed_at.values_mut().for_each(|weighed| drop_at(weighed, window));
        self.windows.remove(window);
    }

    /// What windows gone by said of a part's joint to a parent: nothing of it alone where that parent
    /// had not moved, and so was as good as the world.
    pub(super) fn past_evidence(&self, child: Label, parent: Option<Label>) -> [f64; 3] {
        let Some(options) = self.evidence.get(&child) else { return [0.0; 3] };
        let of =
            |parent: Option<Label>| options.iter().find(|option| option.parent == parent).map(|option| option.past);
        of(parent).or_else(|| of(None)).unwrap_or_default()
    }
}

/// Takes an entry out, if there is one.
fn drop_at<T>(list: &mut Vec<T>, index: usize) {
    if index < list.len() {
        list.remove(index);
    }
}
