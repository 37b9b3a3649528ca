//! The loop of a launcher: asks for demand and jobs, and performs what [`Fleet`] decides.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use access::{Server, explain};
use protocol::demand::Demand;
use protocol::message::ApiError;
use protocol::units::counted;
use reqwest::{Method, StatusCode};
use tokio::time::{sleep, timeout};

use crate::engine::{EngineError, Job, Launcher};
use crate::fleet::{Action, Fleet, Observation, Plan};

/// Wait for a change of demand while nothing else changes.
const QUIET: Duration = Duration::from_secs(10);
/// Wait while jobs come or go.
const BUSY: Duration = Duration::from_secs(1);
/// Shortest time between two passes, and the pause after an error.
const PASS: Duration = Duration::from_millis(500);
/// Limit of a call of an engine, above that of each command within it.
const ENGINE: Duration = Duration::from_secs(120);

/// The reason for which a launcher ends.
#[derive(Debug, thiserror::Error)]
pub enum FollowError {
    #[error("{} failed in a row (--crashes): {last}", counted(*jobs, "job"))]
    Crashes { jobs: u32, last: String },
    /// The token is missing or lacks the scope, or the call is refused for good.
    #[error("{message}")]
    Refused { status: StatusCode, message: String },
    #[error("cannot reach `{url}`: {why}")]
    Unreachable { url: String, why: String },
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// Asks for the demand. `launcher` is the random name of this process; without one, the call only looks.
///
/// # Errors
/// The server refuses the call or cannot be reached.
pub async fn demand(
    server: &Server,
    plan: &Plan,
    launcher: Option<&str>,
    after: Option<u64>,
    wait: Duration,
) -> Result<Demand, FollowError> {
    let mut path = format!("/v1/demand?labels={}&backend={}", plan.labels, plan.backend.name());
    if let Some(launcher) = launcher {
        path += &format!("&launcher={launcher}");
    }
    if let Some(after) = after {
        path += &format!("&after={after}&wait={}", wait.as_secs());
    }
    let unreachable =
        |error: &reqwest::Error| FollowError::Unreachable { url: server.url().to_owned(), why: explain(error) };
    let request = server.request(Method::GET, &path).timeout(wait + ENGINE);
    let answer = server.send(request).await.map_err(|error| unreachable(&error))?;
    let status = answer.status();
    let body = answer.bytes().await.map_err(|error| unreachable(&error))?;
    if status.is_success() {
        return serde_json::from_slice(&body).map_err(|error| FollowError::Refused {
            status,
            message: format!("cannot read the demand of `{}`: {error}; use the same build", server.url()),
        });
    }
    let said = serde_json::from_slice::<ApiError>(&body).map(|error| error.message);
    let message = said.unwrap_or_else(|_| format!("`{}` answered {status}", server.url()));
    Err(if status.is_server_error() || status == StatusCode::TOO_MANY_REQUESTS {
        FollowError::Unreachable { url: server.url().to_owned(), why: message }
    } else {
        FollowError::Refused { status, message }
    })
}

async fn bounded<T>(what: &str, call: impl Future<Output = Result<T, EngineError>>) -> Result<T, EngineError> {
    let hangs = |_| EngineError::Hangs { program: what.to_owned(), limit: ENGINE };
    timeout(ENGINE, call).await.map_err(hangs)?
}

/// The clock of a launcher.
#[derive(Debug)]
struct Clock(Instant);

impl Clock {
    fn now(&self) -> Duration {
        self.0.elapsed()
    }

    fn stamp() -> u64 {
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        u64::try_from(since.as_millis()).unwrap_or_default()
    }
}

/// Follows the demand until an error that no retry mends. Cancelling it leaves the jobs as they are.
///
/// # Errors
/// The limit of crashes, or a refused call.
pub async fn follow(server: &Server, plan: Plan, engine: &dyn Launcher) -> Result<(), FollowError> {
    let clock = Clock(Instant::now());
    let own_name = random_name();
    let mut fleet = Fleet::new(plan);
    let mut version = None;
    let mut is_leading = None;
    let mut last_error = String::new();
    loop {
        let wait = if fleet.is_busy() { BUSY } else { QUIET };
        let demand = match demand(server, fleet.plan(), Some(&own_name), version, wait).await {
            Ok(demand) => demand,
            Err(FollowError::Unreachable { url, why }) => {
                tracing::warn!("cannot reach `{url}`: {why}; jobs stay as they are");
                sleep(4 * PASS).await;
                continue;
            }
            Err(error) => return Err(error),
        };
        let answered = Instant::now();
        version = Some(demand.version);
        let leads = demand.lead_ms > 0;
        if is_leading.replace(leads) != Some(leads) {
            let state = if leads { "following the demand" } else { "another launcher follows this demand; waiting" };
            let plan = fleet.plan();
            tracing::info!(backend = plan.backend.name(), labels = %plan.labels, prefix = plan.prefix, "{state}");
        }
        if leads {
            match bounded("list", engine.list()).await {
                Ok(jobs) => {
                    let seen = Observation { now: clock.now(), stamp: Clock::stamp(), demand: &demand, jobs: &jobs };
                    let until = answered + Duration::from_millis(demand.lead_ms);
                    let actions = fleet.decide(seen);
                    let crashed = fleet.take_crashed();
                    if !crashed.is_empty() {
                        last_error = crash(&crashed, engine);
                        tracing::warn!("{last_error}");
                    }
                    if let Some(error) = perform(&mut fleet, engine, actions, until, &clock).await {
                        last_error = error.to_string();
                    }
                }
                Err(error) => {
                    tracing::warn!("no list of jobs: {error}");
                    sleep(4 * PASS).await;
                }
            }
            if fleet.has_given_up() {
                return Err(FollowError::Crashes { jobs: fleet.plan().crashes, last: last_error });
            }
        }
        sleep(PASS).await;
    }
}

/// The message about jobs that crashed.
fn crash(workers: &[String], engine: &dyn Launcher) -> String {
    let first = workers.first().map_or("NAME", String::as_str);
    format!("{} ended before any work; see the log, {}", workers.join(", "), engine.log().replace("NAME", first))
}

/// Performs actions while this launcher leads. Returns the last error.
async fn perform(
    fleet: &mut Fleet,
    engine: &dyn Launcher,
    actions: Vec<Action>,
    until: Instant,
    clock: &Clock,
) -> Option<EngineError> {
    let mut last = None;
    let mut hangs = false;
    for action in actions {
        match action {
            Action::Submit { worker } => {
                // Later submissions would hang too, and another launcher may lead when they end.
                let result = if hangs || Instant::now() >= until {
                    Err(EngineError::NoSlot("an earlier call took too long".to_owned()))
                } else {
                    bounded("submit", engine.submit(&worker)).await
                };
                match result {
                    Ok(()) => tracing::info!(worker, "submitted"),
                    Err(error) => {
                        tracing::warn!(worker, "not submitted: {error}");
                        hangs |= matches!(error, EngineError::Hangs { .. });
                        fleet.submission_failed(&worker, error.is_transient(), clock.now());
                        last = Some(error);
                    }
                }
            }
            Action::Retire { job } => match bounded("retire", engine.retire(&job)).await {
                Ok(()) => tracing::info!(worker = job.worker, "asked to leave"),
                Err(error) => {
                    tracing::warn!(worker = job.worker, "not asked to leave: {error}");
                    last = Some(error);
                }
            },
        }
    }
    last
}

/// Asks all jobs of a launcher to end. Returns these jobs.
///
/// # Errors
/// The list or one of the calls fails.
pub async fn stop(plan: &Plan, engine: &dyn Launcher) -> Result<Vec<Job>, EngineError> {
    let jobs = jobs(plan, engine).await?;
    for job in &jobs {
        bounded("retire", engine.retire(job)).await?;
    }
    Ok(jobs)
}

/// The jobs of a launcher.
///
/// # Errors
/// The engine does not list them.
pub async fn jobs(plan: &Plan, engine: &dyn Launcher) -> Result<Vec<Job>, EngineError> {
    let mut jobs = bounded("list", engine.list()).await?;
    let prefix = format!("{}-", plan.prefix);
    jobs.retain(|job| job.worker.starts_with(&prefix) && !job.state.has_ended());
    Ok(jobs)
}

fn random_name() -> String {
    let mut bytes = [0; 12];
    // Without randomness, the process id tells launchers of one machine apart.
    if getrandom::fill(&mut bytes).is_err() {
        bytes[..4].copy_from_slice(&std::process::id().to_le_bytes());
    }
    hex::encode(bytes)
}
