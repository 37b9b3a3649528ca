//! `trainer generate --stream` over pipes and over WebSockets at toy sizes: with a control part, by infilling, and with
//! neither.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::process::Stdio;
use std::time::Duration;

use cluster_tests::documented::{run_by, words};
use cluster_tests::{Bench, Running, Said, wait_for};
use nix::sys::signal::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::StatusCode;
use tungstenite::{Message, WebSocket};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
const TOKEN: &str = "0123456789abcdef0123456789abcdef";

/// A model for each way to join segments, and a control part of another base.
const PIPELINE: &str = "name: toy
seed: 3
dataset: {format: synthetic, clips: 40, val: 0.1, test: 0.4}
stages:
  vae: {kind: train.vae, latent: {tokens: 2, dim: 8}, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, steps: 20, batch: {global: 4, slices: 1}, lr: 1e-3, warmup: 2}
  latents: {kind: encode.latents, vae: vae, crops: 2, shards: 1}
  mld: {kind: train.mld, vae: vae, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, steps: 4, batch: {global: 4, slices: 1}}
  lcm: {kind: distill.lcm, guidance: [1, 3], steps: 4, batch: {global: 4, slices: 1}}
  control: {kind: train.control, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, embedding: 16, steps: 4, batch: {global: 4, slices: 1}}
  other: {kind: train.control, model: mld, network: {width: 16, layers: 3, heads: 2, feed_forward: 32}, embedding: 16, steps: 2, batch: {global: 4, slices: 1}}
  evaluator: {kind: train.evaluator, network: {movement: 8, motion: 8, text: 8, embedding: 8}, movement: {until: 0.5, window: 24, batch: 0}, steps: 4, batch: {global: 4, slices: 1}}
  fid: {kind: evaluate.latent_fid, model: lcm, teacher: mld, sampler: {steps: 1, guidance: 2}, repeats: 2, components: 4, shards: 1}
  told: {kind: evaluate.control, joints: [pelvis], percent: [25], sampler: {steps: 1, guidance: 2}, repeats: 1, split: test, all_if_small: true, shards: 1}
  base: {kind: register, model: base, from: [lcm], metric: latent_fid, promote: {to: staging}}
  release: {kind: register, model: control-quickstart, from: [control], metric: average_error, promote: {to: staging}}
  foreign: {kind: register, model: foreign, from: [other], sampler: {steps: 4, guidance: 2}}
  tokenizer: {kind: train.tokenizer, codes: 16, code_dim: 8, quantizers: 1, network: {width: 16, depth: 2, growth: 2}, window: 16, steps: 10, batch: {global: 4, slices: 1}, lr: 1e-3, warmup: 2}
  tokens: {kind: encode.tokens, tokenizer: tokenizer, shards: 1}
  momask: {kind: train.tokens, generator: masked, network: {width: 16, layers: 1, heads: 2, feed_forward: 32, embedding: 8}, steps: 4, batch: {global: 4, slices: 1}, lr: 1e-3}
";

fn bench() -> Bench {
    let bench = Bench::new(TRAINER);
    fs::write(bench.path().join("p.yaml"), PIPELINE).expect("written");
    bench.run(&["run", "p.yaml", "--workers", "1"]).expect_code(0);
    bench
}

/// Streams the sentences in `input`.
fn stream(bench: &Bench, input: &str, arguments: &[&str]) -> Said {
    let mut command = bench.command(&[&["generate", "--stream", "--report", "json"][..], arguments].concat());
    fs::write(bench.path().join("input"), input).expect("written");
    command.stdin(fs::File::open(bench.path().join("input")).expect("the input"));
    Running::start(command).wait()
}

fn frames(said: &Said) -> Vec<Value> {
    said.stdout.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|e| panic!("{line}: {e}"))).collect()
}

/// The report on stderr at the end of a stream.
fn report(said: &Said) -> Value {
    let line = said.stderr.lines().find(|line| line.starts_with('{')).unwrap_or_else(|| panic!("{}", said.stderr));
    serde_json::from_str(line).expect("a report")
}

/// The largest distance that a joint moves from one frame to the next.
fn largest_step(frames: &[Value]) -> f64 {
    let joints = |frame: &Value| -> Vec<f64> {
        let joints = frame["joints"].as_array().expect("joints").iter();
        joints.flat_map(|p| p.as_array().expect("a position")).map(|v| v.as_f64().expect("a number")).collect()
    };
    let step = |pair: &[Value]| {
        let (a, b) = (joints(&pair[0]), joints(&pair[1]));
        let far = |(p, q): (&[f64], &[f64])| p.iter().zip(q).map(|(p, q)| (p - q).powi(2)).sum::<f64>().sqrt();
        a.chunks(3).zip(b.chunks(3)).map(far).fold(0.0, f64::max)
    };
    frames.windows(2).map(step).fold(0.0, f64::max)
}

/// Streams several sentences in one world.
fn goes_on(bench: &Bench, model: &[&str], joining: &str) {
    let input = "a person walks#3s\n\n{\"caption\": \"a person jumps\", \"seconds\": 12}\n\"a person turns\"\n";
    let said = stream(bench, input, &[model, &["-o", "s.html", "-o", "s.npy", "-o", "s.png"]].concat()).expect_code(0);
    let rows = frames(&said);
    let numbers: Vec<u64> = rows.iter().map(|row| row["frame"].as_u64().expect("a number")).collect();
    assert!(numbers.iter().copied().eq(0..rows.len() as u64), "{numbers:?}");
    let of = |line: u64| rows.iter().filter(|row| row["line"] == line).count();
    assert_eq!((of(1), of(3)), (60, 240), "a sentence has as many frames as it says, in segments if need be");
    assert!(of(4) > 0 && of(1) + of(3) + of(4) == rows.len());
    assert!(rows[60]["segment"].as_u64() > rows[59]["segment"].as_u64());
    assert_eq!((&rows[299]["time"], &rows[299]["sentence"]), (&json!(14.95), &json!("a person jumps")));
    assert!(rows.iter().all(|row| row["joints"].as_array().is_some_and(|joints| joints.len() == 22)));
    let root = &rows[0]["joints"][0];
    assert_eq!((&root[0], &root[2]), (&json!(0.0), &json!(0.0)));
    // Models with so little training jump, but not where segments meet.
    let steps: Vec<f64> = rows.windows(2).map(largest_step).collect();
    let junction = |t: usize| rows[t]["segment"] != rows[t + 1]["segment"];
    let (mut at, mut between) = (0.0_f64, 0.0_f64);
    for (t, step) in steps.iter().enumerate() {
        if junction(t) { at = at.max(*step) } else { between = between.max(*step) }
    }
    assert!(at <= 2.0 * between + 0.05, "{joining}: {at} m at a junction, {between} m elsewhere");
    let report = report(&said);
    assert_eq!((&report["joining"], &report["frames"]), (&json!(joining), &json!(rows.len())));
    assert_eq!(report["latency_s"]["count"], 3);
    let segments = report["segments"].as_u64().expect("segments");
    assert_eq!(report["junctions"]["measured"], segments - 1, "{report}");
    eprintln!("{joining}: {report}");
    for file in ["s.html", "s.npy", "s.png"] {
        assert!(fs::metadata(bench.path().join(file)).is_ok_and(|file| file.len() > 1000), "{file}");
    }
    let again = stream(bench, input, model).expect_code(0);
    assert_eq!(frames(&again), rows, "the same sentences give the same frames");
    let other = stream(bench, input, &[model, &["--seed", "5", "--frames", "61"]].concat()).expect_code(0);
    let other = frames(&other);
    assert!(other.len() == 61 && other[60]["joints"] != rows[60]["joints"]);
}

/// Follows a path through sentences: the documented example, by the documented command.
fn follows_a_path(bench: &Bench) {
    let root = Bench::repository();
    fs::create_dir_all(bench.path().join("docs")).expect("a folder");
    std::os::unix::fs::symlink(root.join("docs/examples"), bench.path().join("docs/examples")).expect("a link");
    let lines = run_by(&root, "tests/process/streaming.rs");
    assert!(lines.len() >= 2, "{lines:?}");
    for line in lines {
        let words = words(&line);
        assert_eq!(words[0], "trainer", "{line}");
        let (arguments, input) = match words.iter().position(|word| word == "<") {
            Some(at) => (&words[1..at], Some(&words[at + 1])),
            None => (&words[1..], None),
        };
        let mut command = bench.command(&arguments.iter().map(String::as_str).collect::<Vec<_>>());
        if let Some(input) = input {
            command.stdin(fs::File::open(bench.path().join(input)).expect("the example"));
        }
        let said = Running::start(command).wait().expect_code(0);
        assert!(format!("{}{}", said.stdout, said.stderr).contains("12 target positions"), "{line}: {}", said.stderr);
        if input.is_some() {
            let rows = frames(&said);
            let mut sentences: Vec<&Value> = rows.iter().map(|row| &row["sentence"]).collect();
            sentences.dedup();
            assert_eq!(sentences.len(), 3, "the sentence changes twice: {sentences:?}");
        }
    }
    for file in ["eight.png", "eight-stream.html"] {
        assert!(fs::metadata(bench.path().join(file)).is_ok_and(|file| file.len() > 1000), "{file}");
    }
}

/// Refused inputs with their messages.
fn mistakes(bench: &Bench) {
    const CONTROL: [&str; 2] = ["--model", "control-quickstart@staging"];
    let path = |rows: &str| {
        fs::write(bench.path().join("path.csv"), format!("t,joint,x,y,z\n{rows}")).expect("written");
    };
    for (rows, more, wanted) in [
        ("0,pelvis,0,1,0\n3,pelvis,0,1,2\n", &["--frames", "40"][..], "3.00 s is outside the motion"),
        ("0,tail,0,1,0\n", &[], "`tail` is not a joint of a skeleton with 22 joints"),
        ("0,pelvis,0,1,0\n0.1,pelvis,0,1,1.5\n", &[], "15.0 m/s"),
        ("0,pelvis,4,1,0\n", &[], "starts at x = 0.00"),
    ] {
        path(rows);
        let draw = ["generate", "walks", "--control", "path.csv", "-o", "w.npy"];
        let said = bench.run(&[&draw[..], &CONTROL, more].concat()).expect_code(2);
        assert!(said.stderr.contains(wanted), "{rows}: {}", said.stderr);
    }
    path("0,pelvis,0,1,0\n");
    let base = ["generate", "walks", "--control", "path.csv", "-o", "w.npy", "--model", "base@staging"];
    let said = bench.run(&base).expect_code(2);
    assert!(said.stderr.contains("no control part"), "{}", said.stderr);
    let said = bench.run(&[&base[..], &["--control-from", "foreign:1"]].concat()).expect_code(2);
    assert!(said.stderr.contains("registry show") && said.stderr.contains("denoiser"), "{}", said.stderr);
    bench.run(&[&base[..], &["--control-part", "control-quickstart@staging"]].concat()).expect_code(0);
    let said = bench.run(&["generate", "walks", "--control-scale", "2", "-o", "w.npy", "--model", "base@staging"]);
    assert!(said.expect_code(2).stderr.contains("`--control-scale` has no effect without"));
    let said = bench.run(&["generate", "walks", "--refine", "1001", "-o", "w.npy", "--model", "base@staging"]);
    assert!(said.expect_code(2).stderr.contains("1001 is not in 0..=1000"));

    let told = |waypoints: &str| format!("a person walks\n{{\"caption\": \"w\", \"waypoints\": {waypoints}}}\n");
    for (input, model, wanted) in [
        (String::new(), &CONTROL[..], "standard input: has no sentence"),
        (told("[[0, 0, 1]]"), &CONTROL[..], "line 2: waypoints: path[0]"),
        (told("[[0, 90, 1, 0]]"), &CONTROL[..], "line 2: `pelvis` starts at"),
        (told("[[0, 0, 1, 0]]"), &["--model", "base@staging"], "line 2: has waypoints, but the model has no control"),
        ("walks#soon".to_owned(), &CONTROL[..], "line 1: `soon` is not a length"),
        ("walks\n".to_owned(), &["--model", "base@staging", "--overlap", "900"][..], ""),
    ] {
        let said = stream(bench, &input, model);
        if wanted.is_empty() {
            // This model is not conditioned on earlier frames, so the overlap has no effect.
            said.expect_code(0);
            continue;
        }
        let said = said.expect_code(2);
        assert!(said.stderr.contains(wanted), "{input}: {}", said.stderr);
        assert_eq!(frames(&said).is_empty(), !input.starts_with("a person"), "what comes before it is given out");
    }
    let said = stream(bench, "walks\n", &[&CONTROL[..], &["--overlap", "900"]].concat()).expect_code(2);
    assert!(said.stderr.contains("have no new frames"), "{}", said.stderr);
    for arguments in [&["walks"][..], &["--edit", "x.npy", "--keep", ":1"], &["-n", "2"], &["--positions", "x.npy"]] {
        stream(bench, "walks\n", &[&CONTROL, arguments].concat()).expect_code(2);
    }
}

/// A reader that leaves, and one that waits.
fn is_read_as_it_goes(bench: &Bench) {
    let start = |more: &[&str]| {
        let mut command = bench.command(&[&["generate", "--stream", "--model", "base@staging"][..], more].concat());
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().expect("the trainer starts")
    };
    // The stream is endless until its output is closed.
    let mut child = start(&[]);
    let mut input = child.stdin.take().expect("piped");
    writeln!(input, "a person walks").expect("written");
    let mut output = BufReader::new(child.stdout.take().expect("piped")).lines();
    for _ in 0..500 {
        output.next().expect("a frame").expect("text");
    }
    drop(output);
    assert_eq!(child.wait().expect("it ends").code(), Some(0), "quietly");

    // With a pace, a new sentence does not wait for the end of a segment.
    let mut child = start(&["--pace", "50"]);
    let mut input = child.stdin.take().expect("piped");
    let mut output = BufReader::new(child.stdout.take().expect("piped")).lines();
    let mut frame =
        || -> Value { serde_json::from_str(&output.next().expect("a frame").expect("text")).expect("JSON") };
    writeln!(input, "a person walks").expect("written");
    for _ in 0..5 {
        frame();
    }
    writeln!(input, "a person jumps").expect("written");
    drop(input);
    let first = std::iter::from_fn(|| Some(frame())).find(|frame| frame["line"] == 2).expect("the other sentence");
    assert!(first["frame"].as_u64().expect("a number") < 100, "{}", first["frame"]);
    while output.next().is_some() {}
    assert_eq!(child.wait().expect("it ends").code(), Some(0), "at the end of its input");
}

type Socket = WebSocket<TcpStream>;

fn connect(address: &str, token: Option<&str>) -> Result<Socket, StatusCode> {
    let mut request = format!("ws://{address}/v1/stream").into_client_request().expect("a request");
    if let Some(token) = token {
        let value = format!("Bearer {token}").parse().expect("a header");
        request.headers_mut().insert("authorization", value);
    }
    let tcp = TcpStream::connect(address).expect("it listens");
    tcp.set_read_timeout(Some(Duration::from_secs(60))).expect("a timeout");
    match tungstenite::client(request, tcp) {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(answer))) => Err(answer.status()),
        Err(error) => panic!("{error}"),
    }
}

fn message(socket: &mut Socket) -> Option<Value> {
    loop {
        match socket.read() {
            Ok(Message::Text(text)) => return Some(serde_json::from_str(&text).expect("JSON")),
            Ok(Message::Close(_)) | Err(_) => return None,
            Ok(_) => {}
        }
    }
}

fn send(socket: &mut Socket, text: &str) {
    socket.send(Message::text(text)).expect("sent");
}

/// Streams over a WebSocket.
fn is_served(bench: &Bench) {
    let model = ["generate", "--stream", "--model", "control-quickstart@staging"];
    let said = bench.run(&[&model[..], &["--listen", "127.0.0.1:0"]].concat()).expect_code(2);
    assert!(said.stderr.contains("--listen-token-file"), "{}", said.stderr);
    let tokens = bench.path().join("stream.tokens");
    fs::write(&tokens, format!("viewer read {TOKEN}\nnode worker {}\n", TOKEN.replace('0', "9"))).expect("written");
    fs::set_permissions(&tokens, fs::Permissions::from_mode(0o600)).expect("ours");
    let listens = ["--listen", "127.0.0.1:0", "--listen-token-file", "stream.tokens"];
    let more = ["--streams", "1", "--pace", "500", "--frames", "800"];
    let log = bench.path().join("listen.log");
    let mut server = Running::logged(&mut bench.command(&[&model[..], &listens, &more].concat()), &log);
    let address = wait_for("the stream to listen", || {
        let said = fs::read_to_string(&log).unwrap_or_default();
        assert!(server.alive(), "{said}");
        Some(said.split_once("ws://")?.1.split_once("/v1/stream")?.0.to_owned())
    });

    assert_eq!(connect(&address, None).err(), Some(StatusCode::UNAUTHORIZED));
    assert_eq!(connect(&address, Some("wrong")).err(), Some(StatusCode::UNAUTHORIZED));
    assert_eq!(connect(&address, Some(&TOKEN.replace('0', "9"))).err(), Some(StatusCode::FORBIDDEN), "another scope");

    // Any number of silent connections holds no place.
    let silent: Vec<Socket> = (0..40).map(|_| connect(&address, Some(TOKEN)).expect("let in")).collect();
    let mut socket = connect(&address, Some(TOKEN)).expect("let in");
    send(&mut socket, "walks#soon");
    assert!(message(&mut socket).expect("an answer")["error"].to_string().contains("line 1: `soon`"));
    send(&mut socket, "a person walks");
    let mut last = message(&mut socket).expect("a frame");
    assert_eq!(connect(&address, Some(TOKEN)).err(), Some(StatusCode::SERVICE_UNAVAILABLE), "one stream at once");
    drop(silent);
    assert_eq!((&last["frame"], &last["line"]), (&json!(0), &json!(2)));
    send(&mut socket, "{\"caption\": \"a person jumps\", \"waypoints\": [[0, 900, 1, 0]]}");
    send(&mut socket, "{\"caption\": \"a person jumps\", \"seconds\": 2}");
    let (mut errors, mut jumps) = (0, 0);
    let end = loop {
        let next = message(&mut socket).expect("frames until the bound");
        if next.get("end").is_some() {
            break next;
        }
        if next.get("error").is_some() {
            errors += 1;
            continue;
        }
        assert_eq!(next["frame"].as_u64(), last["frame"].as_u64().map(|frame| frame + 1));
        jumps += usize::from(next["line"] == 4);
        last = next;
    };
    assert_eq!((errors, &end["end"]["frames"]), (1, &json!(800)));
    assert!(jumps >= 40, "{jumps} frames of the last sentence");
    assert!(message(&mut socket).is_none(), "it closes");

    // The place is free again; a message beyond the limit ends the connection.
    let mut socket = wait_for("the place to be free", || connect(&address, Some(TOKEN)).ok());
    // The server may close before all of it is sent.
    let _ = socket.send(Message::text("a".repeat(100_000)));
    assert!(message(&mut socket).is_none());
    // A client that leaves without a close message frees its place.
    let mut socket = wait_for("the place to be free", || connect(&address, Some(TOKEN)).ok());
    send(&mut socket, "a person walks");
    message(&mut socket).expect("a frame");
    drop(socket);
    drop(wait_for("the place to be free", || connect(&address, Some(TOKEN)).ok()));
    server.signal(Signal::SIGTERM);
    assert_eq!(server.wait().code, Some(0));
}

#[test]
fn motion_without_end() {
    let bench = bench();
    goes_on(&bench, &["--model", "control-quickstart@staging"], "control");
    goes_on(&bench, &["--stage", "momask"], "infilling");
    goes_on(&bench, &["--model", "base@staging"], "placement");
    follows_a_path(&bench);
    mistakes(&bench);
    is_read_as_it_goes(&bench);
    is_served(&bench);
    // The registry shows the base of the control part.
    let shown = bench.run(&["registry", "show", "control-quickstart@staging"]).expect_code(0).stdout;
    assert!(shown.contains("control for denoiser=") && shown.contains("bases       base:1\n"), "{shown}");
    let shown = bench.run(&["registry", "show", "foreign:1", "-o", "json"]).expect_code(0).json();
    assert!(shown.get("bases").is_none(), "its base is not registered: {shown}");
}
