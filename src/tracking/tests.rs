//! The filter on simulated tracks.
