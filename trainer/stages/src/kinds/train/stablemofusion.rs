//! `train.stablemofusion`: diffusion of motion itself. Source: StableMoFusion (arXiv:2405.05691).

use protocol::stage::TrainStableMoFusion;

use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::motion_networks::Architecture;
use crate::train::Average;
use crate::train::data::features::{Cut, Rules};
use crate::train::feature_diffusion::{Recipe, family, run};

impl Gang for TrainStableMoFusion {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let every = self.ema_every;
        let average = Average { decay: self.ema_decay(), every, starts_as_copy: true };
        let recipe = Recipe {
            architecture: Architecture::StableMoFusion(self.network.clone()),
            rules: Rules {
                cut: Cut::Whole,
                tokens: true,
                whole: true,
                max_frames: self.max_frames,
                bias: self.feature_bias,
            },
            masked: false,
            guidance_dropout: self.guidance_dropout,
            dropout: self.network.dropout,
            average: (self.ema > 0.0).then_some(average),
            diffusion: &self.diffusion,
            losses: &self.losses,
            training: &self.training,
            family: family(self)?,
        };
        run(cx, recipe, |meta, init| meta.stablemofusion(&self.network, init))
    }
}
