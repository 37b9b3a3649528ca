//! Tests of owners: visibility and control of runs and models, promotion by pipelines, revoked tokens, and the audit
//! log.

mod audit;
mod draws;
mod fuzz;
mod lab;
mod limits;
mod matrix;
mod promotion;
mod tokens;
