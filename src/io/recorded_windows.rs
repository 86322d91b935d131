//! Where a node that recorded ended its windows.
//!
//! When the parts count as at rest goes with what was learned until then, and so, in a node, with how long
//! learning took. The recording says where each window ended, so that its replay learns the same windows.

use std::collections::BTreeSet;
use std::path::Path;

use super::bag::{Bag, BagError, BagSummary, TopicInfo};
use super::cdr::decode;
use super::messages::Header;
use crate::types::Stamp;

/// The topic, as in the code of the node, and its type: a header for every window, stamped like its last frame;
/// the first, stamped 0, is for none and says that the others count.
pub const WINDOWS: (&str, &str) = ("~/windows", "std_msgs/msg/Header");

/// Whether a topic is that of a recording.
fn is_windows(topic: &TopicInfo) -> bool {
    topic.name.ends_with("/windows") && topic.type_name == WINDOWS.1
}

/// The stamps of the last frames of a recording's windows; none where a bag has no such topic.
///
/// # Errors
/// A bag that cannot be opened anew.
pub fn recorded_windows(path: &Path, summary: &BagSummary) -> Result<Option<BTreeSet<Stamp>>, BagError> {
    if !summary.topics.iter().any(|(topic, count)| is_windows(topic) && *count > 0) {
        return Ok(None);
    }
    let messages = Bag::open(path)?.filter(|message| is_windows(&message.topic));
    let headers = messages.filter_map(|message| decode::<Header>(message.bytes()).ok());
    Ok(Some(headers.map(|header| Stamp::from(header.stamp)).collect()))
}
