//! A coordinator and workers as separate processes: the guarantees when one of them stops, hangs or dies.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use cluster_tests::cluster::{Cluster, TOKEN, WORKER_TOKEN, stage_of};
use cluster_tests::network::{Network, SlowLine};
use cluster_tests::{Bench, Running, digests, wait_for};
use nix::sys::signal::Signal;
use protocol::proof::{GRANT_HEADER, SECRET_HEADER};
use serde_json::{Value, json};

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");
/// A stage of several seconds, and the one before it.
pub(super) const VAE: [&str; 8] = [
    "--set",
    "stages.vae.steps=400",
    "--set",
    "stages.vae.windows.until=1",
    "--set",
    "stages.vae.checkpoint.every=50",
    "--until",
    "vae",
];

pub(super) fn config() -> PathBuf {
    Bench::repository().join("configs/smoke.yaml")
}

pub(super) type Curves = BTreeMap<String, Vec<(u64, f64)>>;

/// The undisturbed run of one worker: digests and all recorded values.
fn reference() -> &'static (Value, Curves) {
    static REFERENCE: OnceLock<(Value, Curves)> = OnceLock::new();
    REFERENCE.get_or_init(|| undisturbed(&VAE))
}

fn undisturbed(sets: &[&str]) -> (Value, Curves) {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&config(), sets);
    let view = cluster.wait_end(&run);
    let curves = cluster.metrics(&run, "vae");
    (view, curves)
}

/// Checks that each value was recorded exactly once at the same step, and that the digests are equal.
#[track_caller]
pub(super) fn equals_reference(cluster: &Cluster, run: &str, view: &Value) {
    equals(cluster, run, view, reference());
}

#[track_caller]
pub(super) fn equals(cluster: &Cluster, run: &str, view: &Value, (expected, curves): &(Value, Curves)) {
    assert_eq!(digests(view), digests(expected), "digests");
    let found = cluster.metrics(run, "vae");
    assert_eq!(found.keys().collect::<Vec<_>>(), curves.keys().collect::<Vec<_>>());
    for (key, points) in &found {
        assert_eq!(points.len(), curves[key].len(), "`{key}`: a gap or a double");
        for (point, expected) in points.iter().zip(&curves[key]) {
            assert!(point.0 == expected.0 && point.1.to_bits() == expected.1.to_bits(), "`{key}`: {point:?}");
        }
    }
}

/// Kills the coordinator in the middle of a training stage of two workers and restarts it after `down`.
fn coordinator_away(down: Duration) {
    let mut cluster = Cluster::start(TRAINER);
    for name in ["w1", "w2"] {
        cluster.join(name);
    }
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 20);
    let before = cluster.stage(&run, "vae");
    let pids = ["w1", "w2"].map(|name| cluster.pid(name));
    cluster.kill_server();
    let gone = Instant::now();
    wait_for("the time without a coordinator to pass", || (gone.elapsed() >= down).then_some(()));
    cluster.serve();
    let back = wait_for("a poll after the restart", || {
        let stage = cluster.stage(&run, "vae");
        let over = stage["state"] != "running";
        // Until a worker has polled, the progress is that of the newest checkpoint.
        let polled = down.is_zero()
            || ["w1", "w2"].iter().all(|name| cluster.said(name).contains("the coordinator is reachable again"));
        (over || polled && stage["progress"]["done"].as_u64() > Some(0)).then_some(stage)
    });
    let (was, is) = (before["progress"]["done"].as_u64(), back["progress"]["done"].as_u64());
    eprintln!("away for {down:?}: step {was:?} when it went, {is:?} when it was back");
    let view = cluster.wait_end(&run);
    let stage = stage_of(&view, "vae");
    assert_eq!(stage["attempt"], before["attempt"], "the same attempt goes on");
    assert_eq!(stage["state"], "ran", "nothing was taken up again");
    for (name, pid) in ["w1", "w2"].into_iter().zip(pids) {
        assert!(cluster.alive(name) && cluster.pid(name) == pid, "worker {name} is the same process");
    }
    let joined = cluster.said("w1").matches(" joined").count() + cluster.said("w2").matches(" joined").count();
    assert_eq!(joined, 2, "each worker joined once");
    if down >= Duration::from_secs(5) {
        let over = back["state"] != "running";
        assert!(over || is > was.map(|step| step + 10), "workers go on without a coordinator: from {was:?} to {is:?}");
    }
    equals_reference(&cluster, &run, &view);
    cluster.fsck();
}

/// Sampled: one kill and an immediate restart.
#[test]
fn p4_the_coordinator_is_killed_and_back_at_once() {
    coordinator_away(Duration::ZERO);
}

/// Sampled: 5 s; 60 s, which is four leases, with `STRIDE_LONG_TESTS=1`.
#[test]
fn p4_the_coordinator_is_killed_and_away_for_a_while() {
    coordinator_away(Duration::from_secs(5));
    if fixtures::long("60 s without a coordinator") {
        coordinator_away(Duration::from_secs(60));
    }
}

/// Cuts one of three workers off the network for `how_long`, in the middle of a training stage. The others continue
/// after its lease, and it comes back by itself. If the stage outlasts the cut, because of `sets`, it rejoins the gang.
fn network_cut(how_long: Duration, sets: &[&str], expected: &(Value, Curves), outlasts: bool) {
    let Some(network) = Network::new(3) else { return };
    let mut cluster = Cluster::listen(TRAINER, network.coordinator());
    let names = ["w1", "w2", "w3"];
    for (i, name) in names.into_iter().enumerate() {
        cluster.join_by(name, &network.inside(i), &[]);
    }
    let run = cluster.submit(&config(), sets);
    let is_in =
        |stage: &Value, name: &str| stage["workers"].as_array().is_some_and(|all| all.iter().any(|w| w == name));
    wait_for("all three to be in the gang", || {
        let stage = cluster.stage(&run, "vae");
        assert!(stage["state"] != "ran", "it was over before all were in");
        names.iter().all(|name| is_in(&stage, name)).then_some(())
    });
    cluster.wait_step(&run, "vae", 20);
    let pids = names.map(|name| cluster.pid(name));
    let process_of_w3 = |cluster: &Cluster| {
        let workers = cluster.get("/v1/workers")?;
        workers.as_array()?.iter().find(|worker| worker["worker"] == "w3").cloned()
    };
    let before = process_of_w3(&cluster).expect("it has joined")["incarnation"].clone();
    let done = |stage: &Value| stage["progress"]["done"].as_u64().unwrap_or_default();

    network.cut(2);
    let cut = Instant::now();
    let without = wait_for("the others to be a gang without the one that is cut off", || {
        let stage = cluster.stage(&run, "vae");
        (!is_in(&stage, "w3")).then_some(stage)
    });
    let noticed = cut.elapsed();
    // The cut lasts until the others have continued, however long that takes on a busy machine.
    cluster.wait_step(&run, "vae", done(&without) + 10);
    let stepped = cut.elapsed();
    wait_for("the cut to be over", || (cut.elapsed() >= how_long).then_some(()));
    let during = cluster.stage(&run, "vae");
    network.mend(2);
    let mended = Instant::now();
    wait_for("the worker to be heard again", || {
        let worker = process_of_w3(&cluster)?;
        assert_eq!(worker["incarnation"], before, "the same process: {worker}");
        matches!(worker["state"].as_str(), Some("idle" | "working")).then_some(())
    });
    let heard = mended.elapsed();
    if outlasts {
        wait_for("the worker to be in the gang again", || {
            let stage = cluster.stage(&run, "vae");
            assert!(
                stage["state"] != "ran",
                "the stage was over {:.1?} after the cut, too early to tell",
                mended.elapsed()
            );
            is_in(&stage, "w3").then_some(())
        });
        wait_for("it to take over a peer's state", || {
            cluster
                .said("w3")
                .lines()
                .any(|line| line.contains("met the gang") && line.contains("adopts=true"))
                .then_some(())
        });
    }
    eprintln!(
        "cut for {how_long:?} at least: noticed after {noticed:.1?}, the others 10 steps further after {stepped:.1?}, from step {} to {} during the \
         cut; heard again {heard:.1?} after it",
        done(&without),
        done(&during),
    );
    let view = cluster.wait_end(&run);
    assert_eq!(stage_of(&view, "vae")["attempt"], 1, "the survivors went on from memory");
    for (name, pid) in names.into_iter().zip(pids) {
        assert!(cluster.alive(name) && cluster.pid(name) == pid, "worker {name} is the same process");
        assert_eq!(cluster.said(name).matches(" joined").count(), 1, "worker {name} joined once");
    }
    equals(&cluster, &run, &view, expected);
    cluster.fsck();
}

/// Sampled: a cut just longer than the lease; with `STRIDE_LONG_TESTS=1`, 30 s in a stage that outlasts it.
#[test]
fn p4_a_worker_that_is_cut_off_is_gone_without_and_comes_back_by_itself() {
    network_cut(Duration::from_secs(19), &VAE, reference(), false);
    if !fixtures::long("a network cut of 30 s") {
        return;
    }
    // Enough steps for a gang of three on any machine.
    let seconds = stage_of(&reference().0, "vae")["wall_s"].as_f64().expect("a time");
    let steps = format!("stages.vae.steps={}", (400.0 / seconds * 90.0).clamp(800.0, 20_000.0).round());
    let mut sets = VAE;
    sets[1] = &steps;
    network_cut(Duration::from_secs(30), &sets, &undisturbed(&sets), true);
}

/// One worker is stopped past its lease in the middle of a training stage. The test tries every kind of write in its
/// name, and then the worker itself does.
#[test]
fn p2_a_worker_that_slept_past_its_lease_writes_nothing() {
    let mut cluster = Cluster::start(TRAINER);
    let secret = "the-secret-of-worker-a-known-to-this-test";
    cluster.join_by("a", &["env".to_owned(), format!("STRIDE_WORKER_SECRET={secret}")], &[]);
    let sets = [&VAE[..], &["--set", "stages.vae.workers={min: 1, max: 1}"]].concat();
    let run = cluster.submit(&config(), &sets);
    cluster.wait_step(&run, "vae", 20);
    // The worker's grant, as a poll returns it.
    let workers = cluster.get("/v1/workers").expect("the coordinator is there");
    let post = |cluster: &Cluster, secret: &str, path: &str, body: &Value| {
        let headers = [("content-type", "application/json"), (SECRET_HEADER, secret)];
        cluster.call_as(WORKER_TOKEN, "POST", path, &headers, body.to_string().as_bytes()).expect("answered")
    };
    let poll = json!({"incarnation": workers[0]["incarnation"], "doing": [], "ready": [], "version": 0});
    let orders = post(&cluster, secret, "/v1/workers/a/poll", &poll);
    let grant = orders.body["assignments"][0]["grant"].clone();
    assert_eq!(grant["worker"], "a", "{:?}", orders.body);
    let secret = orders.body["assignments"][0]["secret"].as_str().expect("the grant's secret").to_owned();
    cluster.signal("a", Signal::SIGSTOP);
    let stopped = Instant::now();
    cluster.join("b");
    let taken = wait_for("b to be given the stage", || {
        let stage = cluster.stage(&run, "vae");
        (stage["workers"][0] == "b").then_some(stage)
    });
    let waited = stopped.elapsed();
    eprintln!("a stopped worker's task was another's after {waited:.1?}");
    assert!(waited > Duration::from_secs(14), "unknown is not dead: its lease is 15 s, not {waited:?}");
    assert_eq!(taken["attempt"], 2);
    cluster.wait_step(&run, "vae", 30);

    // Try every kind of write under the old grant.
    let row = json!({"step": 7, "key": "forged", "value": 1.0});
    let manifest =
        stage_of(&cluster.view(&run), "dataset")["outputs"].as_object().expect("outputs").values().next().cloned();
    let writes = [
        ("/v1/metrics", json!({"grant": grant, "rows": [row]})),
        ("/v1/logs", json!({"grant": grant, "first": 1u64 << 40, "lines": ["forged"]})),
        ("/v1/checkpoints", json!({"grant": grant, "step": 5000, "manifest": manifest, "metrics": {}})),
        ("/v1/outcomes", json!({"grant": grant, "outcome": {"outcome": "yielded", "at": 5000}})),
        (
            "/v1/outcomes",
            json!({"grant": grant, "outcome": {"outcome": "finished", "output": manifest, "metrics": {}}}),
        ),
        (
            "/v1/outcomes",
            json!({"grant": grant, "outcome": {"outcome": "failed", "class": "input", "message": "forged"}}),
        ),
    ];
    for (path, body) in &writes {
        let reply = post(&cluster, &secret, path, body);
        assert_eq!((reply.status, reply.body["code"].as_str()), (409, Some("stale-fence")), "{path}: {:?}", reply.body);
        let forged = post(&cluster, "", path, body);
        assert_eq!((forged.status, forged.body["code"].as_str()), (403, Some("unproven")), "{path}: {:?}", forged.body);
    }
    let forged = format!("forged by {}", std::process::id());
    let reply = cluster
        .call_as(
            WORKER_TOKEN,
            "PUT",
            &format!("/v1/blobs/sha256:{}", "0".repeat(64)),
            &[(GRANT_HEADER, &grant.to_string()), (SECRET_HEADER, &secret)],
            forged.as_bytes(),
        )
        .expect("answered");
    assert_eq!((reply.status, reply.body["code"].as_str()), (409, Some("stale-fence")), "blob");

    let logged = cluster.logs(&run).len();
    cluster.signal("a", Signal::SIGCONT);
    wait_for("a to learn that it has lost the stage", || {
        let said = cluster.said("a");
        (said.contains("dropped:") || said.contains("the outcome arrived too late")).then_some(())
    });
    assert!(cluster.alive("a"), "it is back and waits for work");
    let view = cluster.wait_end(&run);
    equals_reference(&cluster, &run, &view);
    assert!(!cluster.metrics(&run, "vae").contains_key("forged"));
    let late = cluster.logs(&run);
    let late = late[logged..].iter().filter(|row| row["worker"] == "a" && row["attempt"] == grant["attempt"]);
    assert_eq!(late.count(), 0, "nothing of the old attempt was stored after its end");
    cluster.fsck();
}

/// Sampled: a kill of rank 0 of two in the middle of a stage, twice.
#[test]
fn p9_values_are_stored_once_though_rank_0_is_killed() {
    let mut cluster = Cluster::start(TRAINER);
    for name in ["w1", "w2"] {
        cluster.join(name);
    }
    let run = cluster.submit(&config(), &VAE);
    for (step, replaced) in [(60, "w3"), (180, "w4")] {
        cluster.wait_step(&run, "vae", step);
        let leader = cluster.stage(&run, "vae")["workers"][0].as_str().expect("a leader").to_owned();
        cluster.kill(&leader);
        cluster.join(replaced);
    }
    let view = cluster.wait_end(&run);
    assert_eq!(stage_of(&view, "vae")["attempt"], 1, "the survivor went on from memory");
    equals_reference(&cluster, &run, &view);
}

/// Sampled: the lines of a training stage whose worker is killed and replaced.
#[test]
fn p13_lines_are_kept_in_order_though_their_worker_is_killed() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 120);
    let before = cluster.logs(&run);
    cluster.kill("w1");
    cluster.join("w2");
    cluster.wait_end(&run);
    let after = cluster.logs(&run);
    assert_eq!(before[..], after[..before.len()], "what was there stays");
    let mut last: BTreeMap<String, u64> = BTreeMap::new();
    for row in &after {
        let line = row["line"].as_u64().expect("a number");
        let before = last.insert(format!("{} {}", row["worker"], row["attempt"]), line);
        assert!(before.is_none_or(|before| before < line), "out of order: {row}");
    }
    assert!(
        after
            .iter()
            .any(|row| row["worker"] == "w2" && row["text"].as_str().unwrap_or_default().contains("continues from"))
    );
}

/// Sampled: a training stage of two workers is paused, resumed and cancelled; the coordinator is killed right after it
/// acknowledged the pause. Also SIGTERM to a worker that trains alone.
#[test]
fn p14_pause_resume_cancel_and_sigterm_end_with_saved_work() {
    let mut cluster = Cluster::start(TRAINER);
    for name in ["w1", "w2"] {
        cluster.join(name);
    }
    let url = cluster.url();
    let verb = |cluster: &Cluster, verb: &str, run: &str| {
        cluster.bench().run(&[verb, run, "--server", &url, "-o", "json"]).expect_code(0).json()["state"].clone()
    };
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 60);
    let asked = Instant::now();
    assert_eq!(verb(&cluster, "pause", &run), "paused");
    cluster.kill_server();
    cluster.serve();
    let released = wait_for("the workers to save and let go", || {
        let stage = cluster.stage(&run, "vae");
        (stage["workers"].as_array().is_some_and(Vec::is_empty)).then_some(stage)
    });
    assert!(asked.elapsed() < Duration::from_secs(35), "within the grace and 5 s, not {:?}", asked.elapsed());
    assert_eq!(released["state"], "ready");
    assert_eq!(cluster.view(&run)["state"], "paused");

    assert_eq!(verb(&cluster, "resume", &run), "running");
    let at = |cluster: &Cluster| cluster.stage(&run, "vae")["progress"]["done"].as_u64().unwrap_or_default();
    let saved = at(&cluster);
    assert!(saved >= 60, "from the checkpoint, not from nothing");
    cluster.wait_step(&run, "vae", saved + 1);

    // One worker leaves in good order with exit code 0; the other continues with its state.
    cluster.signal("w2", Signal::SIGTERM);
    assert_eq!(cluster.ended("w2"), Some(0));
    let before = at(&cluster);
    // The last worker leaves after saving, and its successor continues.
    cluster.signal("w1", Signal::SIGTERM);
    assert_eq!(cluster.ended("w1"), Some(0));
    cluster.join("w3");
    wait_for("w3 to go on from the checkpoint", || cluster.said("w3").contains("continues from").then_some(()));
    cluster.wait_step(&run, "vae", before);
    let view = cluster.wait_end(&run);
    assert_eq!(stage_of(&view, "vae")["state"], "resumed");
    equals_reference(&cluster, &run, &view);

    let second = cluster.submit(&config(), &[&VAE[..], &["--set", "seed=7"]].concat());
    cluster.wait_step(&second, "vae", 20);
    assert_eq!(verb(&cluster, "cancel", &second), "cancelled");
    wait_for("the worker to let go", || {
        cluster
            .get("/v1/workers")
            .filter(|workers| workers.as_array().is_some_and(|all| all.iter().all(|worker| worker["task"].is_null())))
    });
    assert_eq!(cluster.wait_end(&second)["state"], "cancelled");
}

/// 12 kills, at the third to eighth commit of a coordinator, before and after it, while clients submit without a pause.
/// A client without an answer retries with the same key.
#[test]
fn p1_what_a_submission_was_answered_survives_and_counts_once() {
    let bench = Bench::new(TRAINER).with_token(TOKEN);
    let mut known: BTreeMap<String, String> = BTreeMap::new();
    let mut next = 0;
    for (point, at) in ["db::before_commit", "db::after_commit"].into_iter().flat_map(|p| (3..9).map(move |at| (p, at)))
    {
        let free = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = free.local_addr().expect("bound").to_string();
        drop(free);
        let mut command = bench.command(&["serve", "--bind", &address]);
        command.env("STRIDE_FAILPOINT", format!("{point}@{at}"));
        let mut server = Running::start(command);
        let url = format!("http://{address}");
        let mut answered = 0;
        while server.alive() {
            let key = format!("key {next}");
            let said =
                bench.run(&["submit", &config().display().to_string(), "--server", &url, "--idempotency-key", &key]);
            match said.code {
                Some(0) => {
                    let run = said.stdout.trim().to_owned();
                    let before = known.insert(key, run.clone());
                    assert!(before.is_none_or(|before| before == run), "one key gave two runs");
                    (next, answered) = (next + 1, answered + 1);
                }
                // The coordinator is not running yet, or not any more.
                Some(6) => {}
                code => panic!("exit code {code:?}: {}", said.stderr),
            }
            assert!(answered < 20, "{point}@{at} was not reached");
        }
    }
    let said = bench.run(&["status", "--all", "-o", "json"]).expect_code(0).json();
    let stored: Vec<&str> =
        said["runs"].as_array().expect("runs").iter().filter_map(|run| run["run"].as_str()).collect();
    for run in known.values() {
        assert_eq!(stored.iter().filter(|stored| *stored == run).count(), 1, "{run} in {stored:?}");
    }
    // One more run may be stored: the one whose answer the last kill cut off.
    assert!(stored.len() <= known.len() + 1, "{} keys gave {} runs", known.len(), stored.len());
    assert!(known.len() >= 12, "{known:?}");
}

/// 16 coordinators start on one store that does not exist yet.
#[test]
fn p16_of_16_first_starts_one_has_the_store_and_15_say_who() {
    let bench = Bench::new(TRAINER);
    let mut all: Vec<Running> = (0..16).map(|_| bench.spawn(&["serve", "--bind", "127.0.0.1:0"])).collect();
    wait_for("15 to give up", || {
        (all.iter_mut().filter_map(|one| one.alive().then_some(())).count() == 1).then_some(())
    });
    let at = all.iter_mut().position(Running::alive).expect("one is left");
    let winner = all.remove(at);
    let pid = winner.pid().to_string();
    for said in all.into_iter().map(Running::wait) {
        assert_eq!(said.code, Some(2), "{}", said.stderr);
        assert!(said.stderr.contains(&pid), "it should name process {pid}:\n{}", said.stderr);
    }
    // The losers may give up before the winner has made the store.
    wait_for("the winner to serve", || bench.store().join("token").exists().then_some(()));
    winner.signal(Signal::SIGTERM);
    assert_eq!(winner.wait().code, Some(0));
    bench.run(&["registry", "fsck"]).expect_code(0);
}

/// A learning rate under which the loss becomes infinite or NaN after some steps. The failure is reported once, with
/// the step, and not retried.
#[test]
fn p15_a_loss_that_is_no_number_is_final() {
    let bench = Bench::new(TRAINER);
    let config = config().display().to_string();
    let said = bench
        .run(&["run", &config, "--until", "vae", "--set", "stages.vae.lr=1000", "--workers", "1", "-o", "json"])
        .expect_code(1);
    let report: Value = serde_json::from_str(said.stdout.lines().next().map_or("", |_| said.stdout.as_str()))
        .unwrap_or_else(|e| panic!("{e}: {}", said.stdout));
    let message = stage_of(&report, "vae")["message"].as_str().unwrap_or_default().to_owned();
    assert!(message.contains("step"), "{message}\n{}", said.stderr);
    let begun = std::fs::read_to_string(bench.store().join("workers/w1.log")).expect("a log");
    let begins = begun.lines().filter(|line| line.contains(" begin ") && line.contains("/vae attempt=")).count();
    assert_eq!(begins, 1, "tried once:\n{begun}");
}

/// Environment in which a worker dies at the `nth` hit of a fail point.
fn dies_at(point: &str, nth: u32) -> [String; 2] {
    ["env".to_owned(), format!("STRIDE_WORKER_FAILPOINT={point}@{nth}")]
}

/// Sampled: a stage of two workers that saves only at its end. Rank 0 dies when it commits the last step, and, in
/// another run, before it reports the end. The other worker still has the state.
#[test]
fn p4_rank_0_dies_in_its_last_save_and_no_step_is_computed_again() {
    let sets = [
        "--set",
        "stages.vae.steps=150",
        "--set",
        "stages.vae.windows.until=1",
        "--set",
        "stages.vae.checkpoint.every=0",
        "--until",
        "vae",
    ];
    let expected = undisturbed(&sets);
    for point in ["checkpoint::before_commit", "outcome::before_report"] {
        let mut cluster = Cluster::start(TRAINER);
        // Its first report is that of the dataset.
        let nth = if point.starts_with("outcome") { 2 } else { 1 };
        cluster.join_by("w1", &dies_at(point, nth), &[]);
        let run = cluster.submit(&config(), &sets);
        // Check the worker's own log, because the coordinator learns of progress only now and then.
        wait_for("the first worker to train", || cluster.said("w1").contains("met the gang").then_some(()));
        cluster.join("w2");
        wait_for("the second worker to take over the state", || {
            cluster.said("w2").contains("adopts=true").then_some(())
        });
        let view = cluster.wait_end(&run);
        wait_for("the first worker to have died", || (!cluster.alive("w1")).then_some(()));
        let stage = stage_of(&view, "vae");
        assert_eq!(
            (&stage["attempt"], &stage["state"]),
            (&json!(1), &json!("ran")),
            "{point}: {stage:#}\n{}",
            cluster.everything()
        );
        equals(&cluster, &run, &view, &expected);
        cluster.fsck();
    }
}

/// Sampled: the lead of a gang of two is asked to end.
#[test]
fn a_gang_goes_on_at_once_without_a_member_that_is_asked_to_end() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 20);
    cluster.join("w2");
    wait_for("w2 to join the gang", || (cluster.stage(&run, "vae")["workers"].as_array()?.len() == 2).then_some(()));
    cluster.wait_step(&run, "vae", 60);
    cluster.signal("w1", Signal::SIGTERM);
    assert_eq!(cluster.ended("w1"), Some(0));
    let view = cluster.wait_end(&run);
    let stage = stage_of(&view, "vae");
    assert_eq!((stage["state"].as_str(), stage["attempt"].as_u64()), (Some("ran"), Some(1)), "{stage:#}");
    assert!(cluster.said("w2").contains("regrouped after step"), "{}", cluster.said("w2"));
    equals_reference(&cluster, &run, &view);
}

/// Sampled: a worker that trains alone and cannot save because the coordinator is dead.
#[test]
fn a_worker_leaves_in_time_though_the_coordinator_is_gone() {
    let mut cluster = Cluster::start(TRAINER);
    cluster.join_by("w1", &[], &["--leave-within", "3"]);
    let run = cluster.submit(&config(), &VAE);
    cluster.wait_step(&run, "vae", 60);
    cluster.kill_server();
    cluster.signal("w1", Signal::SIGTERM);
    let asked = Instant::now();
    assert_eq!(cluster.ended("w1"), Some(1), "not in good order");
    let took = asked.elapsed();
    eprintln!("a worker without a coordinator left after {took:.1?}");
    assert!(took < Duration::from_secs(10), "it took {took:?}");
    // Acknowledged work is stored.
    cluster.serve();
    cluster.join("w2");
    let view = cluster.wait_end(&run);
    assert!(cluster.said("w2").contains("continues from the checkpoint after step"), "{}", cluster.said("w2"));
    equals_reference(&cluster, &run, &view);
}

/// Sampled: a worker with downloads at 8 kB a second joins while another trains alone. It becomes a member once it has
/// its inputs, and until then it delays no other worker.
#[test]
fn p4_a_slow_joiner_holds_nobody_up() {
    let sets = [
        "--set",
        "stages.vae.steps=4000",
        "--set",
        "stages.vae.windows.until=1",
        "--set",
        "stages.vae.checkpoint.every=200",
        "--until",
        "vae",
    ];
    let mut cluster = Cluster::start(TRAINER);
    cluster.join("w1");
    let run = cluster.submit(&config(), &sets);
    cluster.wait_step(&run, "vae", 20);
    let line = SlowLine::to(cluster.address(), 8_000);
    cluster.join_at(&line.url(), "w2", &[], &[]);
    wait_for("the second worker to be there", || {
        let workers = cluster.get("/v1/workers")?;
        workers.as_array()?.iter().any(|worker| worker["worker"] == "w2").then_some(())
    });
    let done = |cluster: &Cluster| cluster.stage(&run, "vae")["progress"]["done"].as_u64().expect("steps");
    let before = done(&cluster);
    cluster.wait_step(&run, "vae", before + 50);
    let stage = cluster.stage(&run, "vae");
    assert_eq!(stage["workers"], json!(["w1"]), "it fetches, and is no member yet");
    assert!(!cluster.said("w2").contains(" begin "), "{}", cluster.said("w2"));
    line.open();
    wait_for("it to take over the state", || {
        assert!(cluster.stage(&run, "vae")["state"] == "running", "the stage was over too early to tell");
        cluster.said("w2").contains("adopts=true").then_some(())
    });
    cluster.wait_step(&run, "vae", done(&cluster) + 20);
    assert_eq!(cluster.stage(&run, "vae")["attempt"], 1);
    cluster.cancel(&run);
    cluster.fsck();
}

/// Sampled: a worker whose peer port refuses connections trains alone, without a checkpoint. Another one joins the
/// cluster, and the first keeps its steps and its rate.
#[test]
fn p20_a_worker_that_refuses_its_peers_keeps_its_steps_and_its_rate() {
    let sets = [
        "--set",
        "stages.vae.steps=8000",
        "--set",
        "stages.vae.windows.until=1",
        "--set",
        "stages.vae.checkpoint.every=0",
        "--until",
        "vae",
    ];
    let mut cluster = Cluster::start(TRAINER);
    // It listens on the other address family only.
    let port = Cluster::free_address().port();
    cluster.join_by("w1", &[], &["--peer-address", &format!("[::1]:{port}")]);
    let run = cluster.submit(&config(), &sets);
    let at = |cluster: &Cluster| {
        let stage = cluster.stage(&run, "vae");
        (stage["progress"]["done"].as_u64().unwrap_or_default(), stage["attempt"].clone(), stage["workers"].clone())
    };
    // Steps per period; the count never decreases.
    let rate = |cluster: &Cluster, seconds: u64| {
        let (begun, first) = (Instant::now(), at(cluster).0);
        let mut last = first;
        while begun.elapsed() < Duration::from_secs(seconds) {
            let (done, attempt, _) = at(cluster);
            assert!(
                done >= last && attempt == 1,
                "step {last} became {done} in attempt {attempt}\n{}",
                cluster.everything()
            );
            last = done;
            std::thread::sleep(Duration::from_millis(100));
        }
        (last - first) as f64 / begun.elapsed().as_secs_f64()
    };
    cluster.wait_step(&run, "vae", 50);
    let alone = rate(&cluster, 8);
    cluster.join("w2");
    wait_for("the second worker to be there", || {
        let workers = cluster.get("/v1/workers")?;
        workers.as_array()?.iter().any(|worker| worker["worker"] == "w2").then_some(())
    });
    let beside = rate(&cluster, 15);
    eprintln!("{alone:.1} steps a second alone, {beside:.1} beside a worker that cannot reach it");
    assert!(beside >= 0.8 * alone, "{beside:.1} steps a second, {alone:.1} alone\n{}", cluster.everything());
    assert_eq!(at(&cluster).2, json!(["w1"]));
    cluster.cancel(&run);
    cluster.fsck();
}
