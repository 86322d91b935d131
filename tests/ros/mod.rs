//! Runs Python with real ROS 2: `BOM_ROS_ENVIRONMENT` names the file that `rosidl_peer/build.sh` prints.
#![allow(dead_code, clippy::print_stderr, reason = "each test file uses its share")]

use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// The environment to source, or nothing and a line that says so.
pub fn environment() -> Option<PathBuf> {
    let environment = std::env::var_os("BOM_ROS_ENVIRONMENT").map(PathBuf::from);
    if environment.is_none() {
        eprintln!("SKIPPED: BOM_ROS_ENVIRONMENT is not set");
    }
    environment
}

/// What a script of `tests/` prints.
pub fn python(environment: &Path, script: &str, arguments: &[&str]) -> String {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(script);
    let output = Command::new("bash")
        .args(["-c", r#"source "$0" && exec python3 "$@""#])
        .args([environment, &script])
        .args(arguments)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}
