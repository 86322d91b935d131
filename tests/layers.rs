//! The wall between the layers: the `use` lines and paths of src, read as text.
//!
//! A module may use those before it in [`LAYERS`], never those after it. Only geometry knows parry,
//! only the outer layers know files, clocks and the network.
#![allow(clippy::unwrap_used)]

use std::{
    collections::BTreeSet,
    fs,
    path::{Path, PathBuf},
};

/// From the innermost to the outermost; `cli` and `main` are the binary.
const LAYERS: [&str; 18] = [
    "math",
    "types",
    "geometry",
    "registration",
    "mechanism",
    "structure",
    "inference",
    "model",
    "criticism",
    "tracking",
    "particles",
    "pipeline",
    "io",
    "report",
    "ros",
    "node",
    "cli",
    "main",
];
/// The layers that may touch files, clocks and the network.
const OUTER: [&str; 5] = ["io", "report", "node", "cli", "main"];
const LIBRARY: &str = "bayesian_object_models";

/// One source file: its layer, where it is, and its code without comments and tests.
struct Source {
    layer: String,
    path: PathBuf,
    code: String,
}

fn sources() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = Vec::new();
    let mut folders = vec![root.clone()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let relative = path.strip_prefix(&root).unwrap();
            let first = relative.components().next().unwrap().as_os_str().to_str().unwrap();
            let layer = first.trim_end_matches(".rs").to_owned();
            if layer != "lib" {
                let code = code_of(&fs::read_to_string(&path).unwrap());
                found.push(Source { layer, path: relative.to_owned(), code });
            }
        }
    }
    found.sort_by(|a, b| a.path.cmp(&b.path));
    found
}

/// The text without line comments, up to the unit tests at the file's end.
fn code_of(text: &str) -> String {
    let code = text.split("#[cfg(test)]\nmod ").next().unwrap_or_default();
    code.lines().map(|line| line.split("//").next().unwrap_or_default()).collect::<Vec<_>>().join("\n")
}

/// The first segment of every path that starts with `start::`, groups in braces opened.
fn used_after(code: &str, start: &str) -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    let prefix = format!("{start}::");
    for (at, _) in code.match_indices(&prefix) {
        let before = code[..at].chars().next_back();
        if before.is_some_and(|c| c.is_alphanumeric() || c == '_' || c == ':') {
            continue;
        }
        let rest = &code[at + prefix.len()..];
        match rest.strip_prefix('{') {
            Some(group) => names.extend(group_heads(group)),
            None => {
                names.insert(head(rest));
            }
        }
    }
    names
}

fn head(text: &str) -> String {
    text.trim_start().chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
}

/// The heads of `a::b, c::{d, e}, f}`: those outside of inner braces.
fn group_heads(group: &str) -> Vec<String> {
    let (mut depth, mut heads, mut start) = (0, Vec::new(), 0);
    for (at, c) in group.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth == 0 => {
                heads.push(head(&group[start..at]));
                break;
            }
            '}' => depth -= 1,
            ',' if depth == 0 => {
                heads.push(head(&group[start..at]));
                start = at + 1;
            }
            _ => {}
        }
    }
    heads.retain(|name| !name.is_empty());
    heads
}

fn rank(layer: &str) -> usize {
    LAYERS.iter().position(|known| *known == layer).unwrap_or_else(|| panic!("src/{layer} is in no layer"))
}

#[test]
fn dependencies_point_one_way() {
    let mut wrong = Vec::new();
    for source in sources() {
        let is_binary = ["cli", "main"].contains(&source.layer.as_str());
        // In the binary, `crate` is not the library.
        let mut used = used_after(&source.code, LIBRARY);
        if !is_binary {
            used.extend(used_after(&source.code, "crate"));
        }
        for name in used {
            if name != source.layer && rank(&name) >= rank(&source.layer) {
                wrong.push(format!("src/{}: uses {name}, which is above {}", source.path.display(), source.layer));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn only_geometry_knows_parry() {
    for source in sources().iter().filter(|source| source.layer != "geometry") {
        assert!(!source.code.contains("parry3d"), "src/{}", source.path.display());
    }
}

#[test]
fn only_the_outer_layers_touch_files_clocks_and_the_network() {
    let mut wrong = Vec::new();
    for source in sources().iter().filter(|source| !OUTER.contains(&source.layer.as_str())) {
        for outside in used_after(&source.code, "std") {
            if ["fs", "time", "net", "process"].contains(&outside.as_str()) {
                wrong.push(format!("src/{}: std::{outside}", source.path.display()));
            }
        }
        for outside in ["tempfile", "memmap2", "mcap", "indicatif", "anyhow"] {
            if !used_after(&source.code, outside).is_empty() {
                wrong.push(format!("src/{}: {outside}", source.path.display()));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn what_is_used_is_found_in_every_form() {
    let code = "use crate::math::{Pose};\nuse crate::{io::bag::Bag, types::{Label, Stamp}, model};\nlet x = crate::report::y();";
    let used: Vec<String> = used_after(&code_of(code), "crate").into_iter().collect();
    assert_eq!(used, ["io", "math", "model", "report", "types"]);
    assert!(used_after("my_std::fs::read", "std").is_empty());
    let multi_line = "use std::{\n    collections::{BTreeMap, BTreeSet},\n    fs,\n};";
    assert_eq!(used_after(multi_line, "std").into_iter().collect::<Vec<_>>(), ["collections", "fs"]);
    assert_eq!(code_of("a // use crate::io;\n#[cfg(test)]\nmod tests { use crate::io; }"), "a ");
}
