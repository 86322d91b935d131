//! Where a node that recorded ended its windows.
//!
//! When the parts count as at rest goes with what was learned until then, and so, in a node, with how long
//! learning took. The recording says where each window ended, so that its replay learns the same windows.

use std::collections::BTreeSet;
use std::path::Path;

use super::bag::{Bag, BagError, BagSummary};
use super::cdr::decode;
use super::messages::Header;
use crate::types::Stamp;

/// The topic, as in the code of the node, and its type: a header for every window, stamped like its last frame;
/// the first, stamped 0, is for none and says that the others count.
pub const WINDOWS: (&str, &str) = ("~/windows", "std_msgs/msg/Header");

/// Whether a bag is the recording of a node.
fn has_windows(summary: &BagSummary) -> bool {
    let is_it = |name: &str, type_name: &str| name.ends_with("/windows") && type_name == WINDOWS.1;
    summary.topics.iter().any(|(topic, count)| is_it(&topic.name, &topic.type_name) && *count > 0)
}

/// The stamps of the last frames of a recording's windows; none where a bag has no such topic.
///
/// # Errors
/// A bag that cannot be opened anew.
pub fn recorded_windows(path: &Path, summary: &BagSummary) -> Result<Option<BTreeSet<Stamp>>, BagError> {
    if !has_windows(summary) {
        return Ok(None);
    }
    let messages = Bag::open(path)?.filter(|message| message.topic.name.ends_with("/windows"));
    let headers = messages.filter_map(|message| decode::<Header>(message.bytes()).ok());
    Ok(Some(headers.map(|header| Stamp::from(header.stamp)).collect()))
}
