//! A member of a gang that gets its orders from its caller instead of a coordinator, for tests and `benches/links`.
//!
//! Everything between the members is the same as in a worker: listener, handshakes, rendezvous, exchange, regrouping.
//! Nothing is recorded or uploaded, since no server listens.

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use burn::tensor::Device;
use protocol::message::{Assignment, Grant, LossCause, Member, Role, StageTask};
use protocol::stage::{CheckpointPolicy, StageSettings};
use protocol::{Attempt, Fence, Generation, Incarnation, RunId, Seed, StageName, TaskId, WorkerId};
use stages::context::GangContext;
use tokio::runtime::{Handle, Runtime};
use tokio::sync::Notify;

use crate::active_assignment::ActiveAssignment;
use crate::cache::{Bounds, Cache};
use crate::client::Client;
use crate::context::HttpContext;
use crate::event_count::lock;
use crate::gang::endpoint::Endpoint;
use crate::gang::member::Timing;

pub(crate) fn task() -> TaskId {
    TaskId::from("run/vae")
}

/// The order to train as one of `members`.
pub(crate) fn assignment(worker: &WorkerId, generation: u64, members: &[Member], secret: &str) -> Assignment {
    let grant = Grant {
        task: task(),
        attempt: Attempt(1),
        fence: Fence(generation),
        worker: worker.clone(),
        incarnation: Incarnation(1),
    };
    let stage = StageTask {
        run: RunId::from("run"),
        name: StageName::from("vae"),
        // The caller is the stage and needs no settings of a kind.
        settings: StageSettings::all().swap_remove(0),
        inputs: BTreeMap::new(),
        seed: Seed(1),
        checkpoint: CheckpointPolicy::default(),
    };
    let role =
        Role::Member { generation: Generation(generation), members: members.to_vec(), secret: secret.to_owned() };
    Assignment { grant, secret: "secret".to_owned(), stage, role, resume: None, drain: false }
}

/// The context of a stage that is a member, with no server behind it.
pub(crate) fn context(held: Arc<ActiveAssignment>, runtime: Handle) -> HttpContext {
    let server = access::Server::new("http://127.0.0.1:9", None, None).expect("a URL");
    let cache = Arc::new(Cache::new(None, None, Bounds::default()).expect("memory"));
    HttpContext::new(held, Client::new(server, runtime), cache, Arc::default(), Device::default())
}

/// A worker's place in gangs: its name, its listener and its newest orders.
#[derive(Debug)]
pub struct Seat {
    worker: WorkerId,
    endpoint: Arc<Endpoint>,
    held: Mutex<Option<Arc<ActiveAssignment>>>,
    wake: Arc<Notify>,
    runtime: Runtime,
}

impl Seat {
    /// Listens for peers.
    ///
    /// # Errors
    /// If nothing can listen at `address`.
    pub fn listen(name: &str, address: SocketAddr) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
        let endpoint = Endpoint::open(address, Timing::default())?;
        Ok(Self { worker: WorkerId::new(name), endpoint, held: Mutex::default(), wake: Arc::default(), runtime })
    }

    /// Checks that a member that this one will join answers, as a worker does before it is ready for a gang.
    ///
    /// # Errors
    /// If it does not answer.
    pub fn probe(&self, address: &str) -> io::Result<()> {
        self.endpoint.probe(address).map_err(io::Error::other)
    }

    /// Gives this worker its place in a generation: names and addresses of all members, in the order of their ranks.
    pub fn order(&self, generation: u64, members: &[(&str, &str)]) {
        let member = |(name, address): &(&str, &str)| Member {
            worker: WorkerId::new(*name),
            incarnation: Incarnation(1),
            peer_address: (*address).to_owned(),
        };
        let members: Vec<Member> = members.iter().map(member).collect();
        let desired = assignment(&self.worker, generation, &members, &format!("secret {generation}"));
        let mut held = lock(&self.held);
        match &*held {
            Some(held) => held.update(desired),
            None => {
                let wake = self.wake.clone();
                *held = Some(ActiveAssignment::new(desired, self.endpoint.clone(), wake, Arc::default()));
            }
        }
    }

    /// Takes the orders back: the calls of the context fail from now on.
    pub fn dismiss(&self) {
        if let Some(held) = lock(&self.held).take() {
            held.end("dropped from the gang");
        }
    }

    /// The calls of a stage under the orders; `None` without orders.
    pub fn context(&self) -> Option<Context> {
        let held = lock(&self.held).clone()?;
        Some(Context(context(held, self.runtime.handle().clone())))
    }

    /// Waits for a report of lost members for at most `at_most`. Returns the names of the unreachable ones.
    pub fn lost(&self, at_most: Duration) -> Vec<String> {
        self.runtime.block_on(async {
            // A report without a new loss and the end of the time are the same to the caller.
            let _ = tokio::time::timeout(at_most, self.wake.notified()).await;
        });
        let doing = lock(&self.held).as_ref().map(|held| held.doing());
        let lost = doing.into_iter().flat_map(|doing| doing.lost);
        lost.filter(|lost| lost.cause == LossCause::Unreachable).map(|lost| lost.worker.to_string()).collect()
    }
}

/// The calls of a member's stage.
#[derive(Debug)]
pub struct Context(HttpContext);

impl Context {
    /// The calls to the gang.
    pub fn gang(&mut self) -> &mut dyn GangContext {
        &mut self.0
    }

    /// The generation whose members have met last; 0 before.
    pub fn generation(&self) -> u64 {
        self.0.generation().map_or(0, |generation| generation.0)
    }
}
