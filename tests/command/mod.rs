//! Runs the built binary.
#![allow(dead_code, reason = "each test file uses its share")]

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    process::Command,
};

/// What a run said.
#[derive(Debug)]
pub struct Outcome {
    /// Its exit status.
    pub status: i32,
    /// Standard output.
    pub out: String,
    /// Standard error.
    pub err: String,
}

/// `bom ARGUMENTS`, with no logging asked for by the environment.
pub fn bom<A: AsRef<OsStr>>(arguments: &[A]) -> Outcome {
    let output = Command::new(env!("CARGO_BIN_EXE_bom")).args(arguments).env_remove("RUST_LOG").output().unwrap();
    Outcome {
        status: output.status.code().expect("ended by itself"),
        out: String::from_utf8(output.stdout).unwrap(),
        err: String::from_utf8(output.stderr).unwrap(),
    }
}

/// A file of this repository.
pub fn ours(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

/// A file of the public records, or nothing and a line that says so.
#[allow(clippy::print_stderr, reason = "says why a test does nothing")]
pub fn measured(name: &str) -> Option<PathBuf> {
    let path = ours("../shared/measured").join(name);
    if !path.exists() {
        eprintln!("SKIPPED: {} is not there", path.display());
        return None;
    }
    Some(path)
}
