//! Fetching a set from a server on a loopback port that cuts transfers, changes its mind and sends hostile archives.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use flate2::Compression;
use flate2::write::GzEncoder;
use hub::dataset::{Fetch, FetchError, Fetched, Progress, PublicSet, Source, Table};
use protocol::Digest;
use tar::{Builder, EntryType, Header};

/// How the server answers a request.
#[derive(Debug, Clone)]
enum Answer {
    /// The archive, or the part that was asked for.
    Whole,
    /// So many bytes of that, then a closed connection.
    Cut(usize),
    /// The whole archive for every range, cut after so many bytes.
    WithoutRanges(usize),
    Status(u16),
}

#[derive(Debug)]
struct World {
    archive: Vec<u8>,
    etag: String,
    /// Answers in order; then `Whole`.
    answers: VecDeque<Answer>,
    /// The `Range` and `If-Range` of each request.
    asked: Vec<(Option<String>, Option<String>)>,
}

/// The server; its thread ends with the test's process.
struct Server {
    world: Arc<Mutex<World>>,
    address: String,
}

impl Server {
    fn start(archive: Vec<u8>, answers: impl IntoIterator<Item = Answer>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let address = format!("http://{}/set.tar.gz", listener.local_addr().expect("bound"));
        let answers = answers.into_iter().collect();
        let world = World { archive, etag: "\"one\"".into(), answers, asked: Vec::new() };
        let world = Arc::new(Mutex::new(world));
        let shared = Arc::clone(&world);
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                // A client that has enough closes the connection.
                let _ = answer(&shared, stream);
            }
        });
        Self { world, address }
    }

    fn asked(&self) -> Vec<(Option<String>, Option<String>)> {
        std::mem::take(&mut self.world.lock().expect("no panic").asked)
    }

    fn change(&self, change: impl FnOnce(&mut World)) {
        change(&mut self.world.lock().expect("no panic"));
    }
}

fn answer(world: &Mutex<World>, mut stream: TcpStream) -> std::io::Result<()> {
    let mut headers = Vec::new();
    for line in BufReader::new(stream.try_clone()?).lines() {
        let line = line?;
        if line.is_empty() {
            break;
        }
        headers.push(line.to_lowercase());
    }
    let header = |name: &str| headers.iter().find_map(|line| line.strip_prefix(name)).map(str::to_owned);
    let (range, condition) = (header("range: "), header("if-range: "));
    let (how, archive, etag) = {
        let mut world = world.lock().expect("no panic");
        world.asked.push((range.clone(), condition.clone()));
        (world.answers.pop_front().unwrap_or(Answer::Whole), world.archive.clone(), world.etag.clone())
    };
    if let Answer::Status(status) = how {
        return write!(stream, "HTTP/1.1 {status} No\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
    }
    let has_ranges = !matches!(how, Answer::WithoutRanges(_));
    let fits = has_ranges && condition.is_none_or(|condition| condition == etag);
    let start: Option<usize> =
        range.filter(|_| fits).and_then(|range| range.strip_prefix("bytes=")?.strip_suffix('-')?.parse().ok());
    let (from, status) = start.map_or((0, "200 OK"), |from| (from, "206 Partial Content"));
    if from >= archive.len() {
        let size = archive.len();
        return write!(
            stream,
            "HTTP/1.1 416 No\r\ncontent-range: bytes */{size}\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
        );
    }
    let body = &archive[from..];
    let sent = match how {
        Answer::Cut(bytes) | Answer::WithoutRanges(bytes) => &body[..bytes.min(body.len())],
        Answer::Whole | Answer::Status(_) => body,
    };
    let last = archive.len() - 1;
    write!(stream, "HTTP/1.1 {status}\r\ncontent-length: {}\r\nconnection: close\r\n", body.len())?;
    if has_ranges {
        write!(stream, "etag: {etag}\r\n")?;
    }
    if status.starts_with("206") {
        write!(stream, "content-range: bytes {from}-{last}/{}\r\n", archive.len())?;
    }
    write!(stream, "\r\n")?;
    stream.write_all(sent)
}

/// Four recordings that do not compress, so that a cut falls inside them.
fn contents() -> Vec<(String, Vec<u8>)> {
    let noise = |seed: u64| -> Vec<u8> {
        (0..200_u64).flat_map(|i| *Digest::of(&(seed * 1_000 + i).to_le_bytes()).as_bytes()).collect()
    };
    (0..4).map(|i| (format!("take_{i}.bvh"), noise(i))).collect()
}

fn set(contents: &[(String, Vec<u8>)]) -> PublicSet {
    let line = |(name, bytes): &(String, Vec<u8>)| format!("{} {} 90 {name}\n", Digest::of(bytes).hex(), bytes.len());
    let list: String = contents.iter().map(line).collect();
    PublicSet::new("takes", "", "Source: a test\n", &list).expect("a list")
}

/// An archive in the form of GitHub's: a comment in a global extension, a folder, files.
fn archive(members: &[(&str, &[u8])]) -> Vec<u8> {
    let mut builder = Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
    let mut comment = Header::new_ustar();
    comment.set_entry_type(EntryType::XGlobalHeader);
    let text: &[u8] = b"14 comment=xx\n";
    comment.set_size(text.len() as u64);
    comment.set_cksum();
    builder.append(&comment, text).expect("appended");
    for (path, bytes) in members {
        append(&mut builder, path, EntryType::Regular, bytes);
    }
    builder.into_inner().and_then(GzEncoder::finish).expect("finished")
}

/// Appends an entry whose path is not checked.
fn append(builder: &mut Builder<GzEncoder<Vec<u8>>>, path: &str, kind: EntryType, bytes: &[u8]) {
    let mut header = Header::new_ustar();
    header.as_old_mut().name[..path.len()].copy_from_slice(path.as_bytes());
    header.set_entry_type(kind);
    header.set_mode(0o644);
    header.set_size(bytes.len() as u64);
    if kind == EntryType::Symlink {
        header.as_old_mut().linkname[..11].copy_from_slice(b"/etc/passwd");
    }
    header.set_cksum();
    builder.append(&header, bytes).expect("appended");
}

fn good() -> Vec<u8> {
    let contents = contents();
    let mut members: Vec<(String, &[u8])> = vec![("root/README.md".to_owned(), b"words")];
    members.extend(contents.iter().map(|(name, bytes)| (format!("root/data/{name}"), bytes.as_slice())));
    members.push(("root/data/take_9.bvh".to_owned(), b"not listed"));
    let members: Vec<(&str, &[u8])> = members.iter().map(|(path, bytes)| (path.as_str(), *bytes)).collect();
    archive(&members)
}

struct Bench {
    root: tempfile::TempDir,
    set: PublicSet,
}

impl Bench {
    fn new() -> Self {
        Self { root: tempfile::tempdir().expect("a folder"), set: set(&contents()) }
    }

    fn folder(&self) -> PathBuf {
        self.root.path().join("data/takes")
    }

    fn part(&self, name: &str) -> PathBuf {
        self.root.path().join("data/takes.part").join(name)
    }

    fn fetch(&self, source: Source<'_>, partial: bool) -> Result<Fetched, FetchError> {
        let folder = self.folder();
        let fetch = Fetch { set: &self.set, folder: &folder, source, partial, pause: Duration::from_millis(1) };
        let tables = |names: &[&str]| Ok(vec![Table { name: "captions.csv", text: names.join("\n") }]);
        let mut last = None;
        let fetched = fetch.run(&tables, &mut |progress| last = Some(progress));
        if let (Ok(fetched), Some(Progress::Kept { files, of })) = (&fetched, last) {
            assert_eq!((files, of), (fetched.files, of), "progress ends with all files");
        }
        fetched
    }

    fn fetch_from(&self, server: &Server) -> Result<Fetched, FetchError> {
        self.fetch(Source::Address(&server.address), false)
    }

    /// Checks that the set is complete, and that nothing else is left.
    fn expect_complete(&self) {
        for (name, bytes) in contents() {
            assert_eq!(fs::read(self.folder().join(&name)).expect("there"), bytes, "{name}");
        }
        assert_eq!(names(&self.folder()).len(), 6, "{:?}", names(&self.folder()));
        assert_eq!(fs::read_to_string(self.folder().join("SOURCE.txt")).expect("there"), "Source: a test\n");
        assert_eq!(names(&self.root.path().join("data")), ["takes"]);
    }

    /// Checks that no folder claims to be the set, and that nothing was written outside.
    fn expect_unfinished(&self) {
        assert_eq!(names(&self.root.path().join("data")), ["takes.part"]);
        assert_eq!(names(self.root.path()), ["data"]);
    }
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry").file_name());
    let mut names: Vec<String> = entries.map(|name| name.to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

#[test]
fn a_set_is_fetched_once() {
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    let fetched = bench.fetch_from(&server).expect("fetched");
    assert_eq!(fetched, Fetched { files: 4, kept: 0, missing: 0, was_complete: false });
    bench.expect_complete();
    assert_eq!(server.asked(), [(None, None)]);
    // The user's own captions stay.
    fs::write(bench.folder().join("captions.csv"), "mine").expect("written");
    assert!(bench.fetch_from(&server).expect("there").was_complete);
    assert_eq!(server.asked(), []);
    assert_eq!(fs::read_to_string(bench.folder().join("captions.csv")).expect("there"), "mine");
}

#[test]
fn a_cut_transfer_continues_at_its_byte() {
    let (bench, server) = (Bench::new(), Server::start(good(), [Answer::Cut(5_000), Answer::Cut(7_000)]));
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
    let tag = Some("\"one\"".to_owned());
    let range = |from: usize| (Some(format!("bytes={from}-")), tag.clone());
    assert_eq!(server.asked(), [(None, None), range(5_000), range(12_000)]);
}

#[test]
fn another_process_continues_a_transfer() {
    let (bench, server) = (Bench::new(), Server::start(good(), vec![Answer::Cut(9_000)]));
    server.change(|world| world.answers.extend(std::iter::repeat_n(Answer::Status(503), 4)));
    let error = bench.fetch_from(&server).expect_err("the server is away");
    assert!(matches!(error, FetchError::Away { .. }) && error.is_transient(), "{error}");
    assert!(error.advice().contains("the same command continues"));
    bench.expect_unfinished();
    assert_eq!(fs::metadata(bench.part("archive.tar.gz.part")).expect("kept").len(), 9_000);
    server.change(|world| world.answers.clear());
    server.asked();
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
    assert_eq!(server.asked(), [(Some("bytes=9000-".into()), Some("\"one\"".into()))]);
}

#[test]
fn a_server_without_ranges_or_with_another_archive_starts_again() {
    let (bench, server) =
        (Bench::new(), Server::start(good(), [Answer::WithoutRanges(9_000), Answer::WithoutRanges(12_000)]));
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
    assert_eq!(server.asked(), [(None, None), (None, None), (None, None)]);

    let (bench, server) = (Bench::new(), Server::start(vec![7; 20_000], [Answer::Cut(9_000)]));
    server.change(|world| world.answers.extend(std::iter::repeat_n(Answer::Status(503), 4)));
    bench.fetch_from(&server).expect_err("the server is away");
    server.change(|world| {
        world.answers.clear();
        (world.archive, world.etag) = (good(), "\"two\"".into());
    });
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();

    // The archive arrived, but the process ended before it knew.
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    fs::create_dir_all(bench.part("files")).expect("created");
    fs::write(bench.part("archive.tar.gz.part"), good()).expect("written");
    fs::write(bench.part("archive.tar.gz.part.etag"), "\"one\"").expect("written");
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
}

#[test]
fn a_refusal_is_reported_at_once() {
    let (bench, server) = (Bench::new(), Server::start(good(), [Answer::Status(404)]));
    let error = bench.fetch_from(&server).expect_err("refused");
    assert!(matches!(error, FetchError::Refused { .. }) && error.to_string().contains("404"), "{error}");
    assert_eq!(server.asked().len(), 1);
    bench.expect_unfinished();
}

#[test]
fn a_file_with_another_digest_or_size_is_refused_and_the_others_are_kept() {
    let contents = contents();
    let mut other = contents[2].1.clone();
    other[100] ^= 1;
    let cases: [(&[u8], &str); 3] = [
        (&other, "`take_2.bvh` has another SHA-256"),
        (&contents[2].1[..100], "`take_2.bvh` has 100 bytes; expected 6400"),
        (&[], "`take_2.bvh` has 0 bytes"),
    ];
    for (bytes, part) in cases {
        let names: Vec<String> = contents.iter().map(|(name, _)| format!("root/{name}")).collect();
        let mut members: Vec<(&str, &[u8])> =
            names.iter().zip(&contents).map(|(name, (_, bytes))| (name.as_str(), bytes.as_slice())).collect();
        members[2].1 = bytes;
        let (bench, server) = (Bench::new(), Server::start(archive(&members), []));
        let error = bench.fetch_from(&server).expect_err("another file");
        assert!(matches!(error, FetchError::Content { .. }) && error.to_string().contains(part), "{part}: {error}");
        bench.expect_unfinished();
        assert_eq!(self::names(&bench.part("files")), ["take_0.bvh", "take_1.bvh"]);
        server.change(|world| world.archive = good());
        assert_eq!(bench.fetch_from(&server).expect("fetched").kept, 2);
        bench.expect_complete();
    }
}

#[test]
fn an_archive_that_lacks_files_or_ends_early_is_refused() {
    let contents = contents();
    let (name, bytes) = &contents[0];
    let lacking = archive(&[(name.as_str(), bytes.as_slice())]);
    let whole = good();
    let cases = [
        (lacking, "lacks 3 of 4 files: take_1.bvh, take_2.bvh, take_3.bvh"),
        (whole[..whole.len() / 2].to_vec(), "cannot be read"),
        (b"<html>".to_vec(), "not a complete .tar.gz archive"),
        (Vec::from([0x1f, 0x8b]), "not a complete .tar.gz archive"),
    ];
    for (bytes, part) in cases {
        let (bench, server) = (Bench::new(), Server::start(bytes, []));
        let error = bench.fetch_from(&server).expect_err("no such set");
        assert!(error.to_string().contains(part), "{part}: {error}");
        bench.expect_unfinished();
        assert!(!bench.part("archive.tar.gz").exists(), "a wrong archive is not tried again");
        server.change(|world| (world.archive, world.etag) = (good(), "\"two\"".into()));
        bench.fetch_from(&server).expect("fetched");
        bench.expect_complete();
    }
}

#[test]
fn names_of_members_lead_nowhere() {
    let contents = contents();
    let mut builder = Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
    let long = vec![b'a'; 1 << 20];
    append(&mut builder, "././@LongLink", EntryType::GNULongName, &long);
    for name in ["../../evil.bvh", "/tmp/evil.bvh", "a/../../../evil", "..", ".", "take_0.bvh/", "take_0.bvh/.."] {
        append(&mut builder, name, EntryType::Regular, b"evil");
    }
    append(&mut builder, "root/other.bvh", EntryType::Symlink, b"");
    append(&mut builder, "root/fifo", EntryType::Fifo, b"");
    for (name, bytes) in &contents {
        append(&mut builder, &format!("../../../{name}"), EntryType::Regular, bytes);
    }
    let bytes = builder.into_inner().and_then(GzEncoder::finish).expect("finished");
    let (bench, server) = (Bench::new(), Server::start(bytes, []));
    bench.fetch_from(&server).expect("the listed files are there");
    bench.expect_complete();
    assert_eq!(names(bench.root.path()), ["data"]);

    for kind in [EntryType::Symlink, EntryType::Link, EntryType::Fifo, EntryType::Directory] {
        let mut builder = Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
        append(&mut builder, "root/take_0.bvh", kind, b"");
        let bytes = builder.into_inner().and_then(GzEncoder::finish).expect("finished");
        let (bench, server) = (Bench::new(), Server::start(bytes, []));
        let error = bench.fetch_from(&server).expect_err("no file").to_string();
        assert!(error.contains("`take_0.bvh` is not a regular file of the archive"), "{kind:?}: {error}");
        bench.expect_unfinished();
        assert!(names(&bench.part("files")).is_empty());
    }
}

#[test]
fn long_paths_of_every_form_are_read() {
    let contents = contents();
    let folder = "long/".repeat(40);
    let append_file = |builder: &mut Builder<GzEncoder<Vec<u8>>>, name: &str, bytes: &[u8]| {
        append(builder, name, EntryType::Regular, bytes);
    };
    let mut builder = Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
    // As git writes it: the folder in the prefix of the header.
    let mut header = Header::new_ustar();
    header.set_path(format!("{}{}", "long/".repeat(25), contents[0].0)).expect("it has a prefix");
    header.set_size(contents[0].1.len() as u64);
    header.set_cksum();
    builder.append(&header, contents[0].1.as_slice()).expect("appended");
    // As GNU tar writes it.
    append(&mut builder, "././@LongLink", EntryType::GNULongName, format!("{folder}{}\0", contents[1].0).as_bytes());
    append_file(&mut builder, "long/long", &contents[1].1);
    // As Python writes it.
    let path = format!("{folder}{}", contents[2].0);
    builder.append_pax_extensions([("path", path.as_bytes())]).expect("appended");
    append_file(&mut builder, "long/long", &contents[2].1);
    append_file(&mut builder, &contents[3].0, &contents[3].1);
    let bytes = builder.into_inner().and_then(GzEncoder::finish).expect("finished");
    let (bench, server) = (Bench::new(), Server::start(bytes, []));
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();

    // A damaged extension ends the reading.
    let mut builder = Builder::new(GzEncoder::new(Vec::new(), Compression::fast()));
    append(&mut builder, "pax", EntryType::XHeader, b"999999 path=x");
    let bytes = builder.into_inner().and_then(GzEncoder::finish).expect("finished");
    let (bench, server) = (Bench::new(), Server::start(bytes, []));
    let error = bench.fetch_from(&server).expect_err("damaged");
    assert!(matches!(error, FetchError::Content { .. }), "{error}");
    bench.expect_unfinished();
}

#[test]
fn a_full_disk_is_named_and_leaves_nothing_that_looks_complete() {
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    fs::create_dir_all(bench.part("files")).expect("created");
    std::os::unix::fs::symlink("/dev/full", bench.part("archive.tar.gz.part")).expect("linked");
    let error = bench.fetch_from(&server).expect_err("the disk is full");
    assert!(matches!(error, FetchError::DiskFull { bytes: 25_600, .. }), "{error:?}");
    assert!(error.to_string().contains("the disk is full; the set needs 1 MB more"), "{error}");
    bench.expect_unfinished();
    fs::remove_file(bench.part("archive.tar.gz.part")).expect("removed");
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
}

#[test]
fn one_process_fetches_at_a_time() {
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    fs::create_dir_all(bench.part("files")).expect("created");
    let lock = File::create(bench.part("lock")).expect("created");
    lock.lock().expect("locked");
    let error = bench.fetch_from(&server).expect_err("busy");
    assert!(matches!(error, FetchError::Busy { .. }), "{error}");
    assert_eq!(server.asked(), []);
    drop(lock);
    bench.fetch_from(&server).expect("fetched");
}

#[test]
fn what_an_earlier_attempt_left_is_checked() {
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    let contents = contents();
    fs::create_dir_all(bench.part("files")).expect("created");
    fs::write(bench.part("files/take_0.bvh"), &contents[0].1).expect("written");
    fs::write(bench.part("files/take_1.bvh"), &contents[1].1[..50]).expect("written");
    fs::write(bench.part("files/captions.csv"), "half of them").expect("written");
    fs::write(bench.part("files/.tmpX"), "a temporary file").expect("written");
    assert_eq!(bench.fetch_from(&server).expect("fetched").kept, 1);
    bench.expect_complete();
}

#[test]
fn a_clone_or_an_archive_serves_as_well() {
    let bench = Bench::new();
    let clone = tempfile::tempdir().expect("a folder");
    let below = clone.path().join("dataset/data");
    fs::create_dir_all(&below).expect("created");
    let contents = contents();
    for (name, bytes) in &contents[..3] {
        fs::write(below.join(name), bytes).expect("written");
    }
    fs::write(below.join("take_9.bvh"), "not listed").expect("written");
    let from = |partial: bool| bench.fetch(Source::Local(clone.path()), partial);
    let error = from(false).expect_err("a file is missing").to_string();
    assert!(error.contains("lacks 1 of 4 files: take_3.bvh; `--partial` accepts that"), "{error}");
    bench.expect_unfinished();
    let fetched = from(true).expect("complete without it");
    assert_eq!((fetched.files, fetched.missing, fetched.kept), (3, 1, 3));
    assert_eq!(fs::read_to_string(bench.folder().join("captions.csv")).expect("there").lines().count(), 3);
    assert!(from(true).expect("there").was_complete);
    assert!(from(false).expect_err("not whole").to_string().contains("has 3 of 4 files"));

    let bench = Bench::new();
    let file = clone.path().join("set.tar.gz");
    fs::write(&file, good()).expect("written");
    bench.fetch(Source::Local(&file), false).expect("fetched");
    bench.expect_complete();

    let bench = Bench::new();
    fs::write(below.join("take_3.bvh"), "other").expect("written");
    let error = bench.fetch(Source::Local(clone.path()), true).expect_err("another file").to_string();
    assert!(error.contains("`take_3.bvh` has 5 bytes; expected 6400"), "{error}");
    let empty = tempfile::tempdir().expect("a folder");
    let error = bench.fetch(Source::Local(empty.path()), true);
    assert!(error.is_ok(), "the files of the clone were kept");
}

#[test]
fn a_folder_with_something_else_is_left_alone() {
    let (bench, server) = (Bench::new(), Server::start(good(), []));
    fs::create_dir_all(bench.folder()).expect("an empty folder is no obstacle");
    bench.fetch_from(&server).expect("fetched");
    bench.expect_complete();
    fs::write(bench.folder().join("take_2.bvh"), "damaged").expect("written");
    let error = bench.fetch_from(&server).expect_err("a file differs").to_string();
    assert!(error.contains("1 files differ from the published ones: take_2.bvh"), "{error}");
    fs::remove_file(bench.folder().join("take_2.bvh")).expect("removed");
    assert!(bench.fetch_from(&server).expect_err("a file is missing").to_string().contains("has 3 of 4 files"));

    let bench = Bench::new();
    fs::create_dir_all(bench.folder()).expect("created");
    fs::write(bench.folder().join("mine.txt"), "mine").expect("written");
    let error = bench.fetch_from(&server).expect_err("not the set").to_string();
    assert!(error.contains("is not the set `takes`"), "{error}");
    assert_eq!(names(&bench.folder()), ["mine.txt"]);
}
