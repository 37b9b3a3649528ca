//! Tests with real trainer processes that are really killed. Each promise of the design that a process can break is
//! broken here on purpose.
//!
//! The pipeline is `configs/smoke.yaml`: every stage kind of the quickstart at toy sizes.

mod access;
mod backends;
mod bad_input;
mod bandai;
mod buckets;
mod checkpoints;
mod closed_pipes;
mod cluster;
mod damage;
mod demo;
mod determinism;
mod documented;
mod draws;
mod examples;
mod failpoints;
mod files;
mod hub;
mod kinds;
mod launch;
mod memory;
mod mistakes;
mod mocap;
mod motions;
mod page;
mod priorities;
mod push;
mod reading;
mod registry;
mod released;
mod results;
mod running;
mod shares;
mod showpieces;
mod slurm;
mod stand_by;
mod storage;
mod streaming;
mod sweeps;
mod tokens;
mod verify;
mod versions;
mod webhooks;
