//! `train.mdm`: diffusion of motion itself. Source: MDM (arXiv:2209.14916).

use protocol::stage::TrainMdm;

use crate::context::{GangContext, Outcome, StageError};
use crate::kinds::shape::Gang;
use crate::parts::motion_networks::Architecture;
use crate::train::Average;
use crate::train::data::features::{Cut, Rules};
use crate::train::feature_diffusion::{Recipe, family, run};

impl Gang for TrainMdm {
    fn run(&self, cx: &mut dyn GangContext) -> Result<Outcome, StageError> {
        let recipe = Recipe {
            architecture: Architecture::Mdm(self.network.clone()),
            rules: Rules {
                cut: Cut::Jittered,
                tokens: false,
                whole: !self.mask_frames,
                max_frames: self.max_frames,
                bias: 1.0,
            },
            masked: self.mask_frames,
            guidance_dropout: self.guidance_dropout,
            dropout: self.network.dropout,
            average: (self.ema > 0.0).then(|| Average::of(self.ema)),
            diffusion: &self.diffusion,
            losses: &self.losses,
            training: &self.training,
            family: family(self)?,
        };
        run(cx, recipe, |meta, init| meta.mdm(&self.network, init))
    }
}
