//! Bags of every kind are read alike; what is damaged is delivered as far as it goes, and reported.
#![allow(clippy::unwrap_used)]

use std::{
    fs,
    path::{Path, PathBuf},
};

use bayesian_object_models::io::bag::{Bag, BagWriter, Compression};
use proptest::prelude::*;
use tempfile::TempDir;

/// Log time and content of a message.
type Content = (String, u64, Vec<u8>);

/// 200 messages on two topics that a compressor cannot make nothing of, in the order of log times.
fn contents() -> Vec<Content> {
    let topics = ["/a", "/b"];
    let bytes = |index: u64| (0..100).map(|byte| (index * index + 7 * byte) as u8).collect();
    (0..200).map(|index| (topics[index as usize % 2].to_owned(), 1000 * index, bytes(index))).collect()
}

fn write_bag(path: &Path, contents: &[Content], compression: Compression, chunk_size: Option<u64>) {
    let mut writer = BagWriter::create_with(path, compression, chunk_size).unwrap();
    let a = writer.add_topic("/a", "geometry_msgs/msg/WrenchStamped").unwrap();
    let b = writer.add_topic("/b", "tf2_msgs/msg/TFMessage").unwrap();
    for (topic, time, bytes) in contents {
        let id = if topic == "/a" { a } else { b };
        writer.write(id, *time, *time, bytes).unwrap();
    }
    writer.finish().unwrap();
}

fn read(bag: &mut Bag) -> Vec<Content> {
    bag.map(|message| (message.topic.name.clone(), message.log_time_ns, message.bytes().to_vec())).collect()
}

fn read_whole(path: &Path) -> Vec<Content> {
    let mut bag = Bag::open(path).unwrap();
    let found = read(&mut bag);
    assert!(bag.damage().is_empty(), "{:?}", bag.damage());
    assert_eq!(bag.summary().message_count, found.len() as u64);
    assert_eq!(bag.bytes_read(), bag.summary().bytes);
    found
}

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

fn small_bag(folder: &TempDir) -> PathBuf {
    let path = folder.path().join("small.mcap");
    write_bag(&path, &contents(), Compression::Zstd, Some(2000));
    path
}

fn write_metadata(folder: &Path, mode: &str, files: &str) {
    let format = if mode.is_empty() { "" } else { "zstd" };
    let text = format!(
        "rosbag2_bagfile_information:\n  version: 9\n  storage_identifier: mcap\n  duration: {{nanoseconds: 3}}\n  \
         compression_format: \"{format}\"\n  compression_mode: \"{mode}\"\n  relative_file_paths: [{files}]\n"
    );
    fs::write(folder.join("metadata.yaml"), text).unwrap();
}

#[test]
fn chunks_of_every_compression_and_no_chunks_read_alike() {
    let folder = folder();
    let path = folder.path().join("bag.mcap");
    for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
        for chunk_size in [None, Some(500), Some(1 << 20)] {
            write_bag(&path, &contents(), compression, chunk_size);
            assert_eq!(read_whole(&path), contents(), "{compression:?} {chunk_size:?}");
        }
    }
    let summary = Bag::open(&path).unwrap().summary().clone();
    let topics: Vec<_> = summary.topics.iter().map(|(topic, n)| (&*topic.name, &*topic.type_name, *n)).collect();
    assert_eq!(topics, [("/a", "geometry_msgs/msg/WrenchStamped", 100), ("/b", "tf2_msgs/msg/TFMessage", 100)]);
}

#[test]
fn messages_come_in_the_order_of_log_times_though_chunks_overlap() {
    let folder = folder();
    let path = folder.path().join("bag.mcap");
    let mut shuffled = contents();
    for block in shuffled.chunks_mut(50) {
        block.reverse();
    }
    write_bag(&path, &shuffled, Compression::Zstd, Some(1500));
    assert_eq!(read_whole(&path), contents());
}

#[test]
fn rosbag2_folders_split_compressed_or_without_metadata_read_alike() {
    let all = contents();
    let (first, second) = all.split_at(90);
    let split = |names: [&str; 2], compressed: bool| {
        let folder = folder();
        for (name, part) in names.into_iter().zip([first, second]) {
            let path = folder.path().join(name);
            write_bag(&path, part, Compression::None, Some(1000));
            if compressed {
                let packed = zstd::encode_all(fs::File::open(&path).unwrap(), 3).unwrap();
                fs::write(folder.path().join(format!("{name}.zstd")), packed).unwrap();
                fs::remove_file(&path).unwrap();
            }
        }
        folder
    };
    let folder = split(["x_0.mcap", "x_1.mcap"], false);
    write_metadata(folder.path(), "", "x_0.mcap, x_1.mcap");
    assert_eq!(read_whole(folder.path()), all);

    let folder = split(["x_0.mcap", "x_1.mcap"], true);
    write_metadata(folder.path(), "FILE", "x_0.mcap.zstd, x_1.mcap.zstd");
    assert_eq!(read_whole(folder.path()), all);
    assert_eq!(read_whole(&folder.path().join("x_0.mcap.zstd")), first);
    write_metadata(folder.path(), "file", "x_0.mcap, x_1.mcap");
    assert_eq!(read_whole(folder.path()), all, "metadata may name the files without .zstd");

    let folder = split(["x_2.mcap", "x_10.mcap"], false);
    assert_eq!(read_whole(folder.path()), all, "no metadata");
}

#[test]
fn messages_compressed_one_by_one_are_unpacked() {
    let folder = folder();
    let packed: Vec<Content> = contents()
        .into_iter()
        .map(|(topic, time, bytes)| (topic, time, zstd::encode_all(&*bytes, 1).unwrap()))
        .collect();
    write_bag(&folder.path().join("x.mcap"), &packed, Compression::None, None);
    write_metadata(folder.path(), "message", "x.mcap");
    assert_eq!(read_whole(folder.path()), contents());
}

#[test]
fn what_is_no_bag_is_refused_by_name() {
    let folder = folder();
    let refusal = |path: &Path| Bag::open(path).map(|_| ()).unwrap_err().to_string();
    let missing = folder.path().join("missing.mcap");
    assert_eq!(refusal(&missing), format!("{}: No such file or directory (os error 2)", missing.display()));
    assert!(refusal(folder.path()).ends_with("no metadata.yaml and no .mcap file in this folder"));
    for (length, content) in [(0, &b""[..]), (5, b"hello"), (20, b"SQLite format 3\0\0\0\0\0")] {
        let path = folder.path().join("other.mcap");
        fs::write(&path, content).unwrap();
        assert!(refusal(&path).contains(&format!("other.mcap: not an MCAP file ({length} bytes")));
    }
    fs::write(folder.path().join("other.mcap.zstd"), b"not zstd").unwrap();
    assert!(refusal(&folder.path().join("other.mcap.zstd")).contains("other.mcap.zstd: "));
    for (metadata, expected) in [
        ("[1, 2", "metadata.yaml: "),
        (
            "rosbag2_bagfile_information: {storage_identifier: sqlite3}",
            "storage_identifier is `sqlite3`, expected mcap",
        ),
        ("rosbag2_bagfile_information: {compression_format: bz2}", "compression_format is `bz2`"),
        ("rosbag2_bagfile_information: {}", "relative_file_paths is missing or empty"),
        ("rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}", "gone.mcap: No such file"),
    ] {
        fs::write(folder.path().join("metadata.yaml"), metadata).unwrap();
        assert!(refusal(folder.path()).contains(expected), "{}", refusal(folder.path()));
    }
}

#[test]
fn a_missing_file_of_several_is_damage() {
    let folder = folder();
    write_bag(&folder.path().join("x_1.mcap"), &contents(), Compression::Zstd, None);
    write_metadata(folder.path(), "", "x_0.mcap, x_1.mcap");
    let mut bag = Bag::open(folder.path()).unwrap();
    assert_eq!(read(&mut bag), contents());
    assert_eq!(bag.damage().len(), 1);
    assert!(bag.damage()[0].to_string().contains("x_0.mcap"));
}

#[test]
fn a_truncated_bag_gives_all_that_comes_before_the_cut() {
    let folder = folder();
    let path = folder.path().join("bag.mcap");
    let all = contents();
    for (compression, chunk_size) in [
        (Compression::None, Some(3000)),
        (Compression::Zstd, Some(3000)),
        (Compression::Lz4, Some(3000)),
        (Compression::None, None),
    ] {
        write_bag(&path, &all, compression, chunk_size);
        let bytes = fs::read(&path).unwrap();
        let mut most = 0;
        for length in (8..bytes.len()).step_by(197) {
            fs::write(&path, &bytes[..length]).unwrap();
            let mut bag = Bag::open(&path).unwrap();
            let found = read(&mut bag);
            assert_eq!(found, all[..found.len()], "cut at {length}");
            assert!(found.len() >= most, "cut at {length}: fewer messages than from a shorter file");
            assert_eq!(bag.summary().message_count, found.len() as u64);
            most = found.len();
            // A file cut after its data has lost only the summary.
            assert!(bag.damage().len() == 1 || most == all.len(), "cut at {length}: {:?}", bag.damage());
        }
        assert_eq!(most, all.len(), "{compression:?} {chunk_size:?}");
    }
}

#[test]
fn a_truncated_compressed_file_gives_all_that_comes_before_the_cut() {
    let folder = folder();
    let plain = small_bag(&folder);
    // Small frames, so that a cut leaves something; a rosbag2 file is one frame of 128 kB blocks.
    let bytes = fs::read(plain).unwrap();
    let packed: Vec<u8> = bytes.chunks(2000).flat_map(|part| zstd::encode_all(part, 1).unwrap()).collect();
    let path = folder.path().join("cut.mcap.zstd");
    fs::write(&path, &packed[..packed.len() * 2 / 3]).unwrap();
    let mut bag = Bag::open(&path).unwrap();
    let found = read(&mut bag);
    assert!(found.len() > 50 && found.len() < 200);
    assert_eq!(found, contents()[..found.len()]);
    assert!(bag.damage().iter().any(|damage| damage.to_string().contains("cut.mcap.zstd")));
}

#[test]
fn a_corrupt_chunk_is_left_out_and_the_others_are_read() {
    let folder = folder();
    let path = small_bag(&folder);
    let bytes = fs::read(&path).unwrap();
    // Each byte of the first third in turn: magic, header, several chunks with all their fields.
    let all = contents();
    let mut left_out = 0;
    for position in (8..bytes.len() / 3).step_by(3) {
        let mut corrupt = bytes.clone();
        corrupt[position] ^= 0x55;
        fs::write(&path, &corrupt).unwrap();
        let mut bag = Bag::open(&path).unwrap();
        let found = read(&mut bag);
        assert!(found.len() >= 160, "byte {position}: {} messages, {:?}", found.len(), bag.damage());
        assert!(found.iter().all(|message| all.contains(message)), "byte {position}");
        if found.len() < 200 {
            left_out += 1;
            assert!(!bag.damage().is_empty(), "byte {position}");
        }
    }
    assert!(left_out > 300);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn no_bytes_make_the_reader_panic(
        compression in prop_oneof![Just(Compression::None), Just(Compression::Lz4), Just(Compression::Zstd)],
        chunk_size in prop_oneof![Just(None), Just(Some(2000))],
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
        cut in prop::option::of(any::<prop::sample::Index>()),
        noise in prop::collection::vec(any::<u8>(), 0..60),
        noise_at in prop::option::of(any::<prop::sample::Index>()),
    ) {
        let folder = folder();
        let path = folder.path().join("bag.mcap");
        write_bag(&path, &contents()[..60], compression, chunk_size);
        let mut bytes = fs::read(&path).unwrap();
        for (index, value) in changes {
            let position = index.index(bytes.len());
            bytes[position] = value;
        }
        if let Some(index) = noise_at {
            let position = index.index(bytes.len());
            bytes.splice(position..position, noise);
        }
        if let Some(index) = cut {
            bytes.truncate(index.index(bytes.len()));
        }
        fs::write(&path, &bytes).unwrap();
        if let Ok(mut bag) = Bag::open(&path) {
            prop_assert!(read(&mut bag).len() <= 200);
        }
    }
}
