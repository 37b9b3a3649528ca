//! The kinds `train.*`: trainings.

mod control;
mod discord;
mod evaluator;
mod length;
mod mdm;
mod mld;
mod stablemofusion;
mod tokenizer;
mod tokens;
mod vae;

runners! {
    Gang: TrainVae, TrainMld, TrainEvaluator, TrainLength, TrainTokenizer, TrainTokens, TrainDiscord, TrainMdm,
        TrainStableMoFusion, TrainControl;
}
