//! The kinds `evaluate.*`: evaluations.

mod control;
mod latent_fid;
mod recognition;
mod reconstruction;
mod spectrum;
mod t2m;

runners! {
    Plain: EvaluateSpectrum, EvaluateRecognition;
    Map: EvaluateReconstruction, EvaluateLatentFid, EvaluateT2m, EvaluateControl;
}
