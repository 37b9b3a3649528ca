//! A worker against a fake coordinator that can be made to misbehave.

mod blobs;
mod direct;
mod fake;
mod prepare;
mod saves;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Barrier};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use burn::tensor::Device;
use protocol::message::{
    Assignment, FailureClass, Grant, Join, Member, PROTOCOL_VERSION, ReportOutcome, Role, StageTask, TaskOutcome,
};
use protocol::stage::{Backend, CheckpointPolicy, DataSynthetic, StageSettings};
use protocol::{
    ArtifactKind, Attempt, Digest, Fence, Generation, Incarnation, Manifest, RunId, Seed, StageName, TaskId, WorkerId,
};
use stages::context::{AttemptContext, Checkpoint, Exchange, GangContext, Outcome, Part, StageError};
use tokio::runtime::Runtime;

use self::fake::{BUSY_S, Fake, FakeState, LEASE_MS};
use crate::assignments::{self, End, Shared};
use crate::cache::{Bounds, Cache};
use crate::client::Client;
use crate::event_count::lock;
use crate::gang::endpoint::Endpoint;
use crate::gang::member::Timing;
use crate::process;
use crate::stage_limits::StageLimits;
use crate::stage_thread::{self, Bench, Kinds};

pub(crate) use self::fake::server_at;

/// Body of a test's stage.
type Script = Box<dyn Fn(&mut dyn GangContext) -> Result<Outcome, StageError> + Send + Sync>;

struct Scripted(Script);

impl Kinds for Scripted {
    fn alone(&self, _context: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        panic!("these tests run gangs of one, which may ask for everything")
    }

    fn part(&self, _context: &mut dyn AttemptContext, _part: Part) -> Result<Outcome, StageError> {
        panic!("these tests run gangs of one, which may ask for everything")
    }

    fn gang(&self, context: &mut dyn GangContext) -> Result<Outcome, StageError> {
        (self.0)(context)
    }
}

/// A worker on threads of this process.
struct Worker {
    fake: Arc<Fake>,
    shared: Arc<Shared>,
    member: Member,
    stage: JoinHandle<()>,
    poll: JoinHandle<End>,
    preparer: JoinHandle<()>,
    _server: Runtime,
}

impl Worker {
    fn start(script: Script) -> Self {
        Self::start_within(script, StageLimits { memory: None, ..StageLimits::default() })
    }

    fn start_within(script: Script, limits: StageLimits) -> Self {
        Self::start_on(script, limits, Cache::new(None, None, Bounds::default()).expect("memory"))
    }

    fn start_on(script: Script, limits: StageLimits, cache: Cache) -> Self {
        let fake: Arc<Fake> = Arc::default();
        let server = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let server = server.expect("a runtime");
        let listener = server.block_on(tokio::net::TcpListener::bind("127.0.0.1:0")).expect("loopback");
        let url = format!("http://{}", listener.local_addr().expect("bound"));
        let router = fake::router(fake.clone());
        server.spawn(async move { axum::serve(listener, router).await });

        let client = Client::new(server_at(&url), server.handle().clone());
        let endpoint = Endpoint::open(([127, 0, 0, 1], 0).into(), Timing::default()).expect("loopback");
        let peer_address = endpoint.address().to_string();
        let member = Member { worker: "w0".into(), incarnation: Incarnation(1), peer_address: peer_address.clone() };
        let shared = Shared::new(endpoint);
        let cache = Arc::new(cache);
        let preparer = {
            let shared = shared.clone();
            let client = client.clone();
            let cache = cache.clone();
            thread::spawn(move || shared.preparation.run(&client, &cache))
        };
        let bench = Bench {
            kinds: Arc::new(Scripted(script)),
            client: client.clone(),
            cache,
            data: Arc::default(),
            device: Device::default(),
            limits,
        };
        let stage = {
            let shared = shared.clone();
            thread::spawn(move || stage_thread::run(&shared, &bench))
        };
        let offer = Join {
            protocol: PROTOCOL_VERSION,
            worker: "w0".into(),
            pid: 1,
            backend: Backend::Flex,
            instruction_set: "avx2".into(),
            code_versions: protocol::stage::StageSettings::code_versions(),
            peer_address,
            labels: Default::default(),
        };
        let poll = {
            let shared = shared.clone();
            let handle = server.handle().clone();
            thread::spawn(move || {
                let end = handle.block_on(assignments::follow(&client, &offer, &shared));
                shared.end("the worker leaves");
                end
            })
        };
        Self { fake, shared, member, stage, poll, preparer, _server: server }
    }

    /// Grants the task again under the next fence.
    fn grant(&self, attempt: u64) {
        self.grant_from(attempt, None);
    }

    /// Like [`Self::grant`], from a checkpoint.
    fn grant_from(&self, attempt: u64, resume: Option<Digest>) {
        let member = self.member.clone();
        self.fake.desired(|coordinator| {
            coordinator.fence += 1;
            let assignment = assignment(&member, attempt, coordinator.fence);
            coordinator.assignments = vec![Assignment { resume, ..assignment }];
        });
    }

    fn wait(&self, what: &str, mut holds: impl FnMut(&FakeState) -> bool) {
        let begun = Instant::now();
        while !holds(&lock(&self.fake.coordinator)) {
            assert!(begun.elapsed() < Duration::from_secs(30), "{what}: {:?}", lock(&self.fake.coordinator));
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Lets the worker leave and returns everything that the coordinator has received.
    fn leave(self) -> FakeState {
        self.fake.desired(|coordinator| coordinator.leave = true);
        assert_eq!(self.poll.join().expect("no panic"), End::Left);
        self.stage.join().expect("no panic");
        self.preparer.join().expect("no panic");
        let received = std::mem::take(&mut *lock(&self.fake.coordinator));
        assert_eq!(received.early, [0; 0], "values and manifests arrive before the commit");
        received
    }
}

fn assignment(member: &Member, attempt: u64, fence: u64) -> Assignment {
    Assignment {
        grant: Grant {
            task: TaskId::from("run/stage"),
            attempt: Attempt(attempt),
            fence: Fence(fence),
            worker: WorkerId::from("w0"),
            incarnation: Incarnation(1),
        },
        secret: format!("the-secret-of-fence-{fence}"),
        stage: StageTask {
            run: RunId::from("run"),
            name: StageName::from("stage"),
            settings: StageSettings::DataSynthetic(DataSynthetic::default()),
            inputs: BTreeMap::new(),
            seed: Seed(1),
            checkpoint: CheckpointPolicy::default(),
        },
        role: Role::Member {
            generation: Generation(fence),
            members: vec![member.clone()],
            secret: "secret".to_owned(),
        },
        resume: None,
        drain: false,
    }
}

/// A stage that allocates memory until it is stopped. The failure names the amount, and the stage stops because its
/// grant ends.
#[test]
fn a_stage_beyond_its_memory_fails_for_good_and_stops() {
    let more = 64 << 20;
    let limits = StageLimits {
        memory: process::memory().map(|memory| memory.anonymous + more),
        grace: Duration::from_secs(60),
        ..StageLimits::default()
    };
    let script: Script = Box::new(move |context| {
        let mut taken = Vec::new();
        while !context.interrupted() {
            if taken.len() < 64 {
                taken.push(vec![1_u8; 16 << 20]);
            }
            thread::sleep(Duration::from_millis(5));
        }
        Ok(Outcome::Yielded { at: taken.len() as u64 })
    });
    let worker = Worker::start_within(script, limits);
    worker.grant(1);
    worker.wait("the failure is reported", |coordinator| !coordinator.outcomes.is_empty());
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    let received = worker.leave();
    let [report] = received.outcomes.as_slice() else { panic!("{:?}", received.outcomes) };
    let TaskOutcome::Failed { class: FailureClass::OutOfMemory, message } = &report.outcome else {
        panic!("{report:?}")
    };
    assert!(message.contains("expected at most") && message.contains("--stage-memory"), "{message}");
}

fn finished(context: &mut dyn GangContext) -> Result<Outcome, StageError> {
    let output = context.put_manifest(&Manifest::new(ArtifactKind::Report, serde_json::json!({"done": true})))?;
    Ok(Outcome::Finished { output, metrics: BTreeMap::from([("loss".to_owned(), 0.5)]) })
}

/// A checkpoint that waits for a busy store.
fn checkpoint(step: u64, meta: serde_json::Value) -> Checkpoint {
    Checkpoint { step, meta, metrics: BTreeMap::new(), chunk_bytes: protocol::limits::CHUNK_BYTES, may_wait: false }
}

/// Trains `steps` steps as a gang of the current workers, with a checkpoint every tenth step.
fn train(context: &mut dyn GangContext, steps: u64, pause: Duration) -> Result<Outcome, StageError> {
    context.rendezvous(None, &[])?;
    let mut step = 0;
    while step < steps {
        let mut parts: Vec<_> = context.share(2).map(|slice| (slice..slice + 1, vec![1.0])).collect();
        match context.exchange(step..step + 1, 2, &mut parts)? {
            Exchange::Regroup => {
                context.rendezvous(Some(step), &[])?;
            }
            Exchange::Sum { drain, .. } => {
                step += 1;
                context.record(step, &[("loss", 1.0 / step as f64), ("bad", f64::NAN)]);
                context.progress(step, steps, "steps", &[]);
                if step.is_multiple_of(10) || drain {
                    context.log(&format!("saving at {step}"));
                    let blob = context.blobs().put(step.to_le_bytes().to_vec()).expect("stored");
                    context.save(checkpoint(step, serde_json::json!({"blob": blob})), &[])?;
                    assert_eq!(context.saved(true).expect("a save was begun")?, step);
                }
                if drain {
                    return Ok(Outcome::Yielded { at: step });
                }
                thread::sleep(pause);
            }
        }
    }
    finished(context)
}

/// Sampled: one stage of three saves. Every third write is done but its answer is lost.
#[test]
fn p9_everything_arrives_once_though_answers_are_lost() {
    let worker = Worker::start(Box::new(|context| train(context, 100, Duration::ZERO)));
    worker.fake.lossy.store(true, Ordering::SeqCst);
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let steps: Vec<u64> = coordinator.metrics.keys().filter(|(_, key)| key == "loss").map(|(step, _)| *step).collect();
    assert_eq!(steps, (1..=100).collect::<Vec<_>>());
    assert_eq!(coordinator.metrics.len(), 100);
    assert_eq!(coordinator.odd.len(), 100, "what is not a number comes as such");
    let logs: Vec<&str> = coordinator.logs.values().map(String::as_str).collect();
    let saved = |i: u64| [format!("saving at {}", i * 10), format!("checkpoint after step {}, 0 bytes", i * 10)];
    assert_eq!(logs[1..21], (1..=10).flat_map(saved).collect::<Vec<_>>());
    assert!(logs[0].starts_with("attempt 1: ") && logs[0].contains("generation 1 of 1 member, seed "), "{logs:#?}");
    assert!(logs[21].starts_with("finished in ") && logs[21].ends_with(", loss 0.500000"), "{logs:#?}");
    let memory = coordinator.outcomes[0].peak_memory.unwrap();
    assert!(memory > 1 << 20 && logs[21].contains("iB of memory: "), "{memory} {logs:#?}");
    assert_eq!(logs.len(), 22);
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
    assert_eq!(coordinator.joins, 1);
}

#[test]
fn a_name_that_another_process_has_is_waited_for() {
    let worker = Worker::start(Box::new(finished));
    worker.wait("the first join", |coordinator| coordinator.joins == 1);
    worker.fake.name_held.store(3, Ordering::SeqCst);
    lock(&worker.fake.coordinator).forget = true;
    worker.wait("the second join", |coordinator| coordinator.joins == 2);
    assert_eq!(worker.fake.name_held.load(Ordering::SeqCst), 0);
    worker.leave();
}

#[test]
fn the_wait_for_a_name_begins_anew_after_a_restart_of_the_coordinator() {
    let worker = Worker::start(Box::new(finished));
    worker.wait("the first join", |coordinator| coordinator.joins == 1);
    let hold = || {
        worker.fake.name_held.store(u64::MAX, Ordering::SeqCst);
        worker.fake.full.store(false, Ordering::SeqCst);
    };
    hold();
    lock(&worker.fake.coordinator).forget = true;
    // Both times together are longer than the worker waits for a name.
    thread::sleep(Duration::from_millis(2500));
    worker.fake.full.store(true, Ordering::SeqCst);
    worker.fake.name_held.store(0, Ordering::SeqCst);
    worker.wait("a refusal of the coordinator", |_| worker.fake.turned_down.load(Ordering::SeqCst) > 0);
    hold();
    thread::sleep(Duration::from_millis(2500));
    worker.fake.name_held.store(0, Ordering::SeqCst);
    worker.wait("the second join", |coordinator| coordinator.joins == 2);
    worker.leave();
}

#[test]
fn a_coordinator_that_goes_away_and_forgets_is_waited_for() {
    let worker = Worker::start(Box::new(|context| train(context, 200, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.away.store(true, Ordering::SeqCst);
    thread::sleep(Duration::from_millis(2500));
    worker.fake.away.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    lock(&worker.fake.coordinator).forget = true;
    worker.wait("a second join", |coordinator| coordinator.joins == 2);
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), 200);
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
}

#[test]
fn a_coordinator_whose_disk_is_full_is_waited_for() {
    let worker = Worker::start(Box::new(|context| train(context, 200, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.full.store(true, Ordering::SeqCst);
    worker.wait("refusals", |_| worker.fake.turned_down.load(Ordering::SeqCst) >= 3);
    worker.fake.full.store(false, Ordering::SeqCst);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let before = worker.fake.turned_down.load(Ordering::SeqCst);
    worker.fake.full.store(true, Ordering::SeqCst);
    lock(&worker.fake.coordinator).forget = true;
    worker.wait("joins that are refused", |_| worker.fake.turned_down.load(Ordering::SeqCst) >= before + 3);
    worker.fake.full.store(false, Ordering::SeqCst);
    worker.wait("a second join", |coordinator| coordinator.joins == 2);
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), 200, "no row was lost");
    assert!(matches!(coordinator.outcomes[..], [ReportOutcome { outcome: TaskOutcome::Finished { .. }, .. }]));
}

#[test]
fn a_coordinator_that_has_too_much_to_do_is_left_alone_for_as_long_as_it_says() {
    let worker = Worker::start(Box::new(|context| train(context, 1000, Duration::from_millis(5))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 10);
    worker.fake.busy.store(true, Ordering::SeqCst);
    worker.wait("another try", |_| lock(&worker.fake.waited).is_some());
    let waited = lock(&worker.fake.waited).expect("waited");
    assert!(waited >= Duration::from_secs(BUSY_S), "came again after {waited:?}");
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    assert_eq!(worker.leave().metrics.len(), 1000, "no row was lost");
}

#[test]
fn work_that_is_taken_back_is_dropped_without_a_word() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    worker.wait("nothing is done", |coordinator| {
        coordinator.last_poll.as_ref().is_some_and(|poll| poll.doing.is_empty())
    });
    let coordinator = worker.leave();
    assert_eq!(coordinator.outcomes, []);
}

#[test]
fn a_newer_generation_is_taken_on_by_the_same_attempt() {
    let starts = Arc::new(AtomicU64::new(0));
    let counted = starts.clone();
    let worker = Worker::start(Box::new(move |context| {
        counted.fetch_add(1, Ordering::SeqCst);
        train(context, 150, Duration::from_millis(5))
    }));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    // The fence moves first: writes under the old one are refused until the next orders explain it.
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert_eq!(starts.load(Ordering::SeqCst), 1);
    assert_eq!(coordinator.outcomes[0].grant.fence, Fence(2));
    assert_eq!(coordinator.metrics.len(), 150);
}

#[test]
fn another_attempt_begins_anew() {
    let starts = Arc::new(AtomicU64::new(0));
    let counted = starts.clone();
    let worker = Worker::start(Box::new(move |context| {
        let first = counted.fetch_add(1, Ordering::SeqCst) == 0;
        train(context, if first { u64::MAX } else { 5 }, Duration::from_millis(1))
    }));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.grant(2);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    assert_eq!(starts.load(Ordering::SeqCst), 2);
    assert_eq!((coordinator.outcomes.len(), coordinator.outcomes[0].grant.attempt), (1, Attempt(2)));
}

#[test]
fn a_write_under_an_old_fence_ends_the_attempt_once_orders_say_so() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    // Another worker holds the task now: the store has the newer fence, but this worker has no newer orders yet.
    lock(&worker.fake.coordinator).fence = 9;
    thread::sleep(Duration::from_millis(700));
    let stored = lock(&worker.fake.coordinator).metrics.len();
    worker.fake.desired(|coordinator| coordinator.assignments.clear());
    let coordinator = worker.leave();
    assert_eq!(coordinator.metrics.len(), stored, "nothing is written under an old fence");
    assert_eq!(coordinator.outcomes, []);
}

#[test]
fn a_panic_is_a_fault_with_its_place() {
    stage_thread::log_panics();
    let worker = Worker::start(Box::new(|context| {
        context.log("about to fail");
        panic!("the tensor {} is upside down", 3)
    }));
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let TaskOutcome::Failed { class, message } = &coordinator.outcomes[0].outcome else {
        panic!("{:?}", coordinator.outcomes)
    };
    assert_eq!(*class, FailureClass::Fault);
    assert!(message.contains("tests.rs") && message.ends_with("the tensor 3 is upside down"), "{message}");
    let logs: Vec<&String> = coordinator.logs.values().collect();
    assert!(logs.len() == 3 && logs[1] == "about to fail", "{logs:#?}");
    assert!(logs[2].starts_with("failed after ") && logs[2].ends_with(message), "{logs:#?}");
}

#[test]
fn leaving_saves_and_yields() {
    let worker = Worker::start(Box::new(|context| train(context, u64::MAX, Duration::from_millis(1))));
    worker.grant(1);
    worker.wait("some steps", |coordinator| coordinator.metrics.len() > 3);
    worker.shared.leave();
    let poll = worker.poll;
    let stage = worker.stage;
    let fake = worker.fake;
    assert_eq!(poll.join().expect("no panic"), End::Left);
    stage.join().expect("no panic");
    let coordinator = lock(&fake.coordinator);
    let TaskOutcome::Yielded { at } = coordinator.outcomes[0].outcome else { panic!("{:?}", coordinator.outcomes) };
    assert_eq!(coordinator.checkpoints.last().map(|c| c.step), Some(at));
}

#[test]
fn a_poll_whose_connection_hangs_is_followed_by_another_within_the_lease() {
    let worker = Worker::start(Box::new(finished));
    worker.wait("some polls", |coordinator| coordinator.polls.len() > 2);
    worker.fake.hang.store(1, Ordering::SeqCst);
    worker.wait("the hanging one", |_| worker.fake.hang.load(Ordering::SeqCst) == 0);
    let before = lock(&worker.fake.coordinator).polls.len();
    worker.wait("the next ones", |coordinator| coordinator.polls.len() > before + 2);
    let coordinator = worker.leave();
    let longest = coordinator.polls.windows(2).map(|pair| pair[1] - pair[0]).max().expect("polls");
    assert!(longest < Duration::from_millis(LEASE_MS), "not heard of for {longest:?}");
    assert!(longest > Duration::from_millis(LEASE_MS / 3), "one poll did hang: {longest:?}");
}

#[test]
fn an_outcome_that_is_refused_is_a_failure_and_not_silence() {
    let worker = Worker::start(Box::new(finished));
    lock(&worker.fake.coordinator).refuses = true;
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let TaskOutcome::Failed { class, message } = &coordinator.outcomes[0].outcome else {
        panic!("{:?}", coordinator.outcomes)
    };
    assert_eq!(*class, FailureClass::Infrastructure);
    assert!(message.contains("not-found"), "{message}");
}

/// A state that the store does not accept. Each try would train to its first save and fail there.
#[test]
fn what_is_refused_for_good_is_not_tried_again() {
    let worker = Worker::start(Box::new(finished));
    lock(&worker.fake.coordinator).unfit = true;
    worker.grant(1);
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let coordinator = worker.leave();
    let TaskOutcome::Failed { class, message } = &coordinator.outcomes[0].outcome else {
        panic!("{:?}", coordinator.outcomes)
    };
    assert_eq!(*class, FailureClass::Refused);
    assert!(message.contains("too-large"), "{message}");
}

#[test]
fn a_member_that_runs_out_of_memory_says_so_itself() {
    let worker = Worker::start(Box::new(|_| panic!("CUDA_ERROR: out of memory")));
    let first = Member { worker: "other".into(), incarnation: Incarnation(1), peer_address: "127.0.0.1:9".into() };
    let members = vec![first, worker.member.clone()];
    worker.fake.desired(|coordinator| {
        coordinator.fence = 1;
        let mut desired = assignment(&members[1], 1, 1);
        desired.role =
            Role::Member { generation: Generation(1), members: members.clone(), secret: "secret".to_owned() };
        coordinator.assignments = vec![desired];
    });
    worker.wait("an outcome", |coordinator| !coordinator.outcomes.is_empty());
    let outcomes = worker.leave().outcomes;
    let TaskOutcome::Failed { class, .. } = &outcomes[0].outcome else { panic!("{outcomes:?}") };
    assert_eq!((*class, outcomes[0].grant.worker.as_str()), (FailureClass::OutOfMemory, "w0"));
}
