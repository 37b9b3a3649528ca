//! Stages that make or read data stop where they are when their grant ends or they are asked to.
#![allow(clippy::unwrap_used, reason = "a test may panic")]

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::Duration;

use protocol::Seed;
use protocol::message::StageTask;
use protocol::stage::{Backend, CheckpointPolicy, DataFeatures, DataFormat, DataOpen, DataSynthetic, StageSettings};
use stage_lab::{MemoryAttempt, MemoryBlobs};
use stages::context::{Outcome, Part, StageError};

fn attempt(settings: StageSettings) -> MemoryAttempt {
    let task = StageTask {
        run: "run".into(),
        name: "dataset".into(),
        settings,
        inputs: Default::default(),
        seed: Seed(1),
        checkpoint: CheckpointPolicy::default(),
    };
    MemoryAttempt::new(task, models::device::open(Backend::Flex, 0).unwrap(), Arc::<MemoryBlobs>::default())
}

/// A set that takes minutes and gigabytes.
#[test]
fn a_large_synthetic_set_is_given_up_at_once() {
    let settings = DataSynthetic { clips: 100_000, ..DataSynthetic::default() };
    let mut attempt = attempt(StageSettings::DataSynthetic(settings));
    let stop = attempt.stop_switch();
    let stopper = thread::spawn(move || {
        thread::sleep(Duration::from_millis(300));
        stop.store(true, Ordering::Relaxed);
    });
    let outcome = stages::kinds::run_alone(&mut attempt).unwrap();
    stopper.join().unwrap();
    assert_eq!(outcome, Outcome::Yielded { at: 0 });
    let (done, total, unit) = attempt.told.progress.clone().unwrap();
    assert!(done < total / 2 && unit == "clips", "{done} of {total} {unit}");
}

#[test]
fn a_folder_is_given_up_while_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = motion::synthetic::generate(&DataSynthetic { clips: 12, ..DataSynthetic::default() }, Seed(1));
    motion::synthetic::write_folder(&dataset, folder.path()).unwrap();
    let settings = DataOpen { path: folder.path().to_string_lossy().into_owned(), format: DataFormat::Humanml3d };
    let mut attempt = attempt(StageSettings::DataOpen(settings));
    attempt.stop_switch().store(true, Ordering::Relaxed);
    assert_eq!(stages::kinds::run_alone(&mut attempt).unwrap(), Outcome::Yielded { at: 0 });
    assert!(attempt.told.log.is_empty(), "nothing was read: {:?}", attempt.told.log);
}

/// A stage may name a folder of any size. Digesting it stops too, before it is read and for a submission without digests.
#[test]
fn digesting_and_reading_recordings_stop_on_request() {
    let folder = tempfile::tempdir().unwrap();
    mocap::sample::write_bvh_folder(folder.path(), 2, Seed(3)).unwrap();
    let path = folder.path().to_string_lossy().into_owned();
    let mut attempt = attempt(StageSettings::DataFeatures(DataFeatures { path, ..DataFeatures::default() }));
    assert_eq!(stages::external::digests(&attempt).unwrap().len(), 1);
    attempt.stop_switch().store(true, Ordering::Relaxed);
    assert!(matches!(stages::external::digests(&attempt), Err(StageError::Interrupted)));
    let part = Part::Shard { index: 0, of: 1 };
    assert_eq!(stages::kinds::run_part(&mut attempt, part).unwrap(), Outcome::Yielded { at: 0 });
}
