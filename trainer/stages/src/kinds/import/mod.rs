//! The kinds `import.*`: published weights.

mod evaluator;
mod model;

runners! {
    Plain: ImportEvaluator, ImportModel;
}
