//! Kubernetes, through `kubectl`.
//!
//! Each worker is an Indexed Job of one pod, made from the Job template of a suspended CronJob. One Job of many pods
//! would not do: lowering its parallelism ends the pods with the highest indexes, busy or not, and an index that has
//! completed never runs again.

use std::time::Duration;

use async_trait::async_trait;
use serde_json::{Value, json};

use crate::command::{EngineCommand, split_options};
use crate::engine::{EngineError, Job, JobState, Launcher};
use crate::worker_command::WorkerCommand;

/// The CronJob of `ops/kubernetes`.
const TEMPLATE: &str = "stride-worker";
/// The label of the launcher's Jobs.
const LABEL: &str = "stride.dev/launcher";
/// Options of every `kubectl` whose value is the next word.
const WITH_VALUE: [&str; 12] = [
    "-n",
    "--namespace",
    "-s",
    "--server",
    "--as",
    "--cluster",
    "--context",
    "--kubeconfig",
    "--request-timeout",
    "--token",
    "--user",
    "--certificate-authority",
];

/// Jobs of one launcher on Kubernetes.
#[derive(Debug, Clone)]
pub struct Kubernetes {
    worker: WorkerCommand,
    /// The value of the label of its Jobs.
    name: String,
    template: String,
    /// Options of every `kubectl`, such as `--namespace`.
    options: Vec<String>,
    limit: Duration,
}

impl Kubernetes {
    /// The first word of `options` that is no option names the CronJob.
    pub fn new(worker: WorkerCommand, name: String, options: Vec<String>, limit: Duration) -> Self {
        let (options, mut names) = split_options(options, |option| WITH_VALUE.contains(&option));
        let template = if names.is_empty() { TEMPLATE.to_owned() } else { names.swap_remove(0) };
        Self { worker, name, template, options, limit }
    }

    fn kubectl(&self, arguments: &[&str]) -> EngineCommand {
        let own = arguments.iter().map(|argument| (*argument).to_owned());
        EngineCommand::new("kubectl", self.options.iter().cloned().chain(own))
    }

    async fn json(&self, arguments: &[&str]) -> Result<Value, EngineError> {
        let text = self.kubectl(arguments).run(self.limit).await?;
        serde_json::from_str(&text)
            .map_err(|error| EngineError::Answer { program: "kubectl".to_owned(), why: error.to_string() })
    }

    /// The Job of a worker, from a CronJob.
    fn job(&self, cron_job: &Value, worker: &str) -> Result<Value, EngineError> {
        let template = &cron_job["spec"]["jobTemplate"];
        let mut job = json!({
            "apiVersion": "batch/v1",
            "kind": "Job",
            "metadata": {"name": worker, "labels": template["metadata"]["labels"], "annotations": template["metadata"]["annotations"]},
            "spec": template["spec"],
        });
        job["metadata"]["labels"][LABEL] = self.name.as_str().into();
        let spec = &mut job["spec"];
        (spec["completions"], spec["parallelism"]) = (1.into(), 1.into());
        spec["template"]["metadata"]["labels"][LABEL] = self.name.as_str().into();
        let arguments = spec.pointer_mut("/template/spec/containers/0/args").and_then(Value::as_array_mut);
        let arguments = arguments.ok_or_else(|| {
            let why = format!("the first container of CronJob `{}` has no `args`", self.template);
            EngineError::Refused { program: "kubectl".to_owned(), said: why }
        })?;
        arguments.extend(self.worker.options(worker).into_iter().map(Value::from));
        Ok(job)
    }
}

/// Jobs in a list of Kubernetes that have not ended.
fn jobs(list: &Value) -> Vec<Job> {
    let job = |item: &Value| {
        let name = item["metadata"]["name"].as_str()?;
        let status = &item["status"];
        let conditions = status["conditions"].as_array().map(Vec::as_slice).unwrap_or_default();
        let is_over = |condition: &Value| {
            matches!(condition["type"].as_str(), Some("Complete" | "Failed")) && condition["status"] == "True"
        };
        let state = if item["metadata"]["deletionTimestamp"].is_string() {
            JobState::Ending
        } else if conditions.iter().any(is_over) {
            return None;
        } else if status["ready"].as_u64().unwrap_or_default() > 0 {
            JobState::Running
        } else {
            JobState::Pending
        };
        Some(Job { worker: name.to_owned(), id: name.to_owned(), state })
    };
    list["items"].as_array().into_iter().flatten().filter_map(job).collect()
}

#[async_trait]
impl Launcher for Kubernetes {
    async fn list(&self) -> Result<Vec<Job>, EngineError> {
        Ok(jobs(&self.json(&["get", "jobs", "-l", &format!("{LABEL}={}", self.name), "-o", "json"]).await?))
    }

    async fn submit(&self, worker: &str) -> Result<(), EngineError> {
        let cron_job = self.json(&["get", "cronjob", &self.template, "-o", "json"]).await?;
        let job = self.job(&cron_job, worker)?;
        self.kubectl(&["create", "-f", "-"]).with_input(job.to_string()).run(self.limit).await.map(drop)
    }

    async fn retire(&self, job: &Job) -> Result<(), EngineError> {
        if job.state == JobState::Ending {
            return Ok(());
        }
        // In the foreground: the Job is listed until its pod has ended.
        let arguments = ["delete", "job", &job.id, "--cascade=foreground", "--wait=false", "--ignore-not-found"];
        self.kubectl(&arguments).run(self.limit).await.map(drop)
    }

    fn log(&self) -> &'static str {
        "`kubectl logs job/NAME`, while the Job exists"
    }
}

#[cfg(test)]
mod tests {
    use protocol::stage::Backend;

    use super::*;

    #[test]
    fn a_job_is_made_from_the_template_and_named_after_its_worker() {
        let worker = WorkerCommand {
            program: String::new(),
            url: String::new(),
            backend: Backend::Cuda,
            labels: "gpu=h100".parse().expect("a label"),
            more: Vec::new(),
        };
        let options = ["--namespace=stride", "big-worker"].map(str::to_owned).to_vec();
        let kubernetes = Kubernetes::new(worker, "stride-a".into(), options, Duration::from_secs(1));
        assert_eq!((kubernetes.template.as_str(), kubernetes.options.len()), ("big-worker", 1));
        let options = ["-n", "stride", "big-worker"].map(str::to_owned).to_vec();
        let other = Kubernetes::new(kubernetes.worker.clone(), "stride-a".into(), options, Duration::from_secs(1));
        assert_eq!((other.template.as_str(), other.options.join(" ").as_str()), ("big-worker", "-n stride"));
        let cron_job = json!({"spec": {"jobTemplate": {
            "metadata": {"labels": {"kueue.x-k8s.io/queue-name": "gpus"}},
            "spec": {"completionMode": "Indexed", "template": {"spec": {"containers": [{"args": ["worker", "join", "u"]}]}}},
        }}});
        let job = kubernetes.job(&cron_job, "stride-a-1").expect("a job");
        assert_eq!(job["metadata"]["labels"]["kueue.x-k8s.io/queue-name"], "gpus");
        assert_eq!(job["metadata"]["labels"][LABEL], "stride-a");
        assert_eq!(job["spec"]["template"]["metadata"]["labels"][LABEL], "stride-a");
        assert_eq!(job["spec"]["completions"], 1);
        let arguments = &job["spec"]["template"]["spec"]["containers"][0]["args"];
        let expected =
            json!(["worker", "join", "u", "--name", "stride-a-1", "--backend", "cuda", "--label", "gpu=h100"]);
        assert_eq!(*arguments, expected);
        let error = kubernetes.job(&json!({}), "x").expect_err("no container");
        assert!(error.to_string().contains("has no `args`"), "{error}");
    }

    #[test]
    fn jobs_that_have_ended_are_not_listed() {
        let done = json!([{"type": "Complete", "status": "True"}]);
        let list = json!({"items": [
            {"metadata": {"name": "a"}, "status": {"active": 1, "ready": 1}},
            {"metadata": {"name": "b"}, "status": {"active": 1, "ready": 0}},
            {"metadata": {"name": "c"}, "status": {"conditions": done}},
            {"metadata": {"name": "d", "deletionTimestamp": "2026-01-01T00:00:00Z"}, "status": {"active": 1}},
            {"metadata": {"name": "e"}, "spec": {"suspend": true}},
        ]});
        let found: Vec<_> = jobs(&list).into_iter().map(|job| (job.worker, job.state)).collect();
        let expected =
            [("a", JobState::Running), ("b", JobState::Pending), ("d", JobState::Ending), ("e", JobState::Pending)];
        assert_eq!(found, expected.map(|(name, state)| (name.to_owned(), state)));
    }
}
