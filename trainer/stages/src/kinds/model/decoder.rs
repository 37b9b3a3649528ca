//! `model.decoder`: combines the parts of a token or latent model with a flow decoder.

use std::collections::BTreeMap;

use checkpoint::model::Model;
use protocol::ArtifactKind;
use protocol::artifact::Role;
use protocol::stage::ModelDecoder;

use crate::artifacts;
use crate::context::{AttemptContext, Outcome, StageError};
use crate::generate::generator::{LATENT_DIFFUSION, TOKENS};
use crate::kinds::shape::Plain;
use crate::parts::flow_decoder::FlowDecoder;
use crate::parts::{self, model_error};

impl Plain for ModelDecoder {
    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        let blobs = cx.blobs();
        let (_, manifest) = artifacts::input(cx, "model", ArtifactKind::Model)?;
        let model = Model::read(&manifest).map_err(model_error)?;
        let role = match &model.generator[..] {
            TOKENS => Role::TOKENIZER,
            LATENT_DIFFUSION => Role::VAE,
            other => {
                return Err(StageError::Input(format!(
                    "the generator `{other}` of `model` makes neither tokens nor latents, so there is nothing to decode"
                )));
            }
        };
        let (_, decoder) = artifacts::input(cx, "decoder", ArtifactKind::FlowDecoder)?;
        FlowDecoder::read(&*blobs, &decoder, (&role, model.part(&role).map_err(model_error)?), &cx.device())?;
        let part = |(role, digest): (&Role, &protocol::Digest)| {
            Ok((role.clone(), parts::manifest(&*blobs, *digest, &format!("the part `{role}`"))?))
        };
        let mut all = model.parts.iter().map(part).collect::<Result<BTreeMap<_, _>, StageError>>()?;
        all.insert(Role::DECODER, decoder);
        let output = parts::publish_model(cx, &model.generator, model.format, &all)?;
        Ok(Outcome::Finished { output, metrics: BTreeMap::new() })
    }
}
