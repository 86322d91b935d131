//! A progress bar on a terminal, and log lines that do not tear it.

use std::io::{self, Write};
use std::sync::{LazyLock, PoisonError, RwLock};

use indicatif::{ProgressBar, ProgressStyle};

/// The bar that is shown, if any.
static SHOWN: LazyLock<RwLock<Option<ProgressBar>>> = LazyLock::new(|| RwLock::new(None));

/// A bar over bytes, on standard error; nothing where that is no terminal.
pub struct Progress(ProgressBar);

impl Progress {
    pub fn of_bytes(total: u64) -> Self {
        let bar = ProgressBar::new(total);
        let template = "{bar:40} {percent:>3} % {bytes}, {eta} left, {msg}";
        bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
        *SHOWN.write().unwrap_or_else(PoisonError::into_inner) = Some(bar.clone());
        Self(bar)
    }

    pub fn at(&self, bytes: u64) {
        self.0.set_position(bytes);
    }

    pub fn say(&self, message: String) {
        self.0.set_message(message);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
        *SHOWN.write().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

/// Writes to standard error, the bar out of the way meanwhile.
pub struct AboveTheBar;

impl AboveTheBar {
    pub fn new() -> Self {
        Self
    }
}

impl Write for AboveTheBar {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let write = || io::stderr().lock().write_all(bytes).map(|()| bytes.len());
        match &*SHOWN.read().unwrap_or_else(PoisonError::into_inner) {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().lock().flush()
    }
}
