//! Slurm, through `sbatch`, `squeue` and `scancel`.
//!
//! A job is never requeued: Slurm holds a requeued job for two minutes by default, and a new one starts at once. A
//! running job gets SIGTERM and nothing else, at its end of time too; the worker then saves and leaves. Only options of
//! old versions are used (22.05 was tested): newer ones of `squeue` differ between sites.

use std::time::Duration;

use async_trait::async_trait;

use crate::command::EngineCommand;
use crate::engine::{EngineError, Job, JobState, Launcher};
use crate::worker_command::{WITHOUT_TOKEN, WorkerCommand};

/// Seconds before a job's end of time at which its worker is asked to leave. Longer than leaving takes.
const NOTICE: u32 = 60;

/// Jobs of one launcher on Slurm.
#[derive(Debug, Clone)]
pub struct Slurm {
    pub worker: WorkerCommand,
    /// Options of `sbatch`.
    pub options: Vec<String>,
    /// Limit of each command.
    pub limit: Duration,
}

impl Slurm {
    fn submission(&self, worker: &str) -> EngineCommand {
        let own = ["--parsable".to_owned(), "--no-requeue".to_owned(), format!("--signal=B:TERM@{NOTICE}")];
        let name = format!("--job-name={worker}");
        let arguments = own.into_iter().chain([name]).chain(self.options.iter().cloned());
        // `exec`, because the signal goes to the shell of the batch job alone.
        let script = format!("#!/bin/sh\n{WITHOUT_TOKEN}\nexec {}\n", self.worker.line(worker));
        EngineCommand::new("sbatch", arguments).with_input(script)
    }
}

/// Lists ended jobs too, which Slurm forgets after some minutes.
fn queue() -> EngineCommand {
    EngineCommand::new("squeue", ["-h", "-t", "all", "-u", &nix::unistd::getuid().to_string(), "-o", "%i|%T|%j"])
}

/// Reads the answer of [`queue`].
fn jobs(text: &str) -> Vec<Job> {
    let job = |line: &str| {
        let (id, rest) = line.trim().split_once('|')?;
        let (state, worker) = rest.split_once('|')?;
        let state = match state {
            "PENDING" | "CONFIGURING" => JobState::Pending,
            "COMPLETING" => JobState::Ending,
            "CANCELLED" | "NODE_FAIL" | "PREEMPTED" => JobState::Revoked,
            "BOOT_FAIL" | "COMPLETED" | "DEADLINE" | "FAILED" | "OUT_OF_MEMORY" | "TIMEOUT" => return None,
            _ => JobState::Running,
        };
        Some(Job { worker: worker.to_owned(), id: id.to_owned(), state })
    };
    text.lines().filter_map(job).collect()
}

fn ending(job: &Job) -> Option<EngineCommand> {
    match job.state {
        // This has no effect if the job has started meanwhile. It then gets the signal at the next call.
        JobState::Pending => Some(EngineCommand::new("scancel", ["--state=PENDING", &job.id])),
        JobState::Running => Some(EngineCommand::new("scancel", ["--batch", "--signal=TERM", &job.id])),
        JobState::Ending | JobState::Revoked => None,
    }
}

#[async_trait]
impl Launcher for Slurm {
    async fn list(&self) -> Result<Vec<Job>, EngineError> {
        Ok(jobs(&queue().run(self.limit).await?))
    }

    async fn submit(&self, worker: &str) -> Result<(), EngineError> {
        self.submission(worker).run(self.limit).await.map(drop)
    }

    async fn retire(&self, job: &Job) -> Result<(), EngineError> {
        match ending(job) {
            Some(command) => command.run(self.limit).await.map(drop),
            None => Ok(()),
        }
    }

    fn log(&self) -> &'static str {
        "slurm-JOB.out in this folder, if the options name no other file"
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::Backend;

    use super::*;

    #[test]
    fn a_job_is_submitted_once_and_ended_by_a_signal() {
        let worker = WorkerCommand {
            program: "/opt/stride/trainer".into(),
            url: "https://coordinator:7700".into(),
            backend: Backend::Cuda,
            labels: "gpu=h100".parse().expect("a label"),
            more: vec!["--data-root".into(), "/data sets".into()],
        };
        let slurm = Slurm { worker, options: vec!["--gres=gpu:1".into()], limit: Duration::from_secs(1) };
        let submission = slurm.submission("stride-a-1");
        assert_eq!(submission.program, "sbatch");
        assert_eq!(
            submission.arguments.join(" "),
            "--parsable --no-requeue --signal=B:TERM@60 --job-name=stride-a-1 --gres=gpu:1"
        );
        assert_eq!(
            submission.input,
            "#!/bin/sh\nunset STRIDE_TOKEN STRIDE_TOKEN_FILE\nexec /opt/stride/trainer worker join \
             https://coordinator:7700 --name stride-a-1 --backend cuda --label gpu=h100 --data-root '/data sets'\n"
        );
        let found = jobs(
            "7|RUNNING|stride-a-1\n8|PENDING|stride-a-2\n9|COMPLETING|x\n5|PREEMPTED|y\n6|FAILED|z\n\nslurm_load_jobs error\n",
        );
        let shown: Vec<_> = found.iter().map(|job| (job.id.as_str(), job.worker.as_str(), job.state.name())).collect();
        assert_eq!(
            shown,
            [
                ("7", "stride-a-1", "running"),
                ("8", "stride-a-2", "pending"),
                ("9", "x", "ending"),
                ("5", "y", "revoked")
            ]
        );
        let ends: Vec<_> = found.iter().filter_map(ending).map(|command| command.arguments.join(" ")).collect();
        assert_eq!(ends, ["--batch --signal=TERM 7", "--state=PENDING 8"]);
    }
}
