//! Sampler of a command: the one of the model's evaluation, with the user's changes.

use clap::Args;
use protocol::stage::{Sampler, Solver, measured_with};

/// Parts of a sampler, besides its steps.
#[derive(Debug, Args)]
pub(super) struct SamplerArgs {
    /// Guidance: a teacher's scale g, a student's w = g - 1 [default: as in the model's evaluation]
    #[arg(long, value_name = "W", value_parser = guidance, allow_negative_numbers = true)]
    guidance: Option<f64>,
    /// Timesteps of an LCM student, noisiest first, such as 999,499 [default: as in the model's evaluation]
    #[arg(long, value_name = "T", value_delimiter = ',')]
    timesteps: Vec<usize>,
    /// Solver: ddpm, ddim, dpm-solver, dpm-solver++, sde-dpm-solver++ [default: as in the model's evaluation]
    #[arg(long, value_name = "SOLVER", value_parser = solver)]
    solver: Option<Solver>,
    /// Corrects foot sliding by moving the root: true or false [default: as in the model's evaluation]
    #[arg(long, value_name = "BOOL")]
    footing: Option<bool>,
}

/// Parses a scale of classifier-free guidance.
fn guidance(text: &str) -> Result<f64, String> {
    let scale: f64 = text.parse().map_err(|_| "expected a number, such as 2.5".to_owned())?;
    if scale.is_finite() && scale >= 0.0 {
        return Ok(scale);
    }
    Err("expected 0 or more; a larger value makes a motion follow its sentence more closely".to_owned())
}

/// Parses a solver by its word in settings.
fn solver(word: &str) -> Result<Solver, String> {
    serde_json::from_value(word.into()).map_err(|e| e.to_string())
}

impl SamplerArgs {
    /// Returns the sampler to use, with the options applied. It is that of the evaluations in `measured` that match the
    /// options, else that of all evaluations if they agree, else `own`, the model's sampler.
    ///
    /// # Errors
    /// If the matching evaluations use several samplers.
    pub(super) fn sampler(
        &self,
        steps: Option<usize>,
        own: Sampler,
        measured: &[(String, Sampler)],
    ) -> Result<Sampler, String> {
        let steps = steps.or((!self.timesteps.is_empty()).then_some(self.timesteps.len()));
        let as_asked = |sampler: &Sampler| {
            steps.is_none_or(|steps| steps == sampler.steps)
                && self.guidance.is_none_or(|guidance| guidance == sampler.guidance)
                && (self.timesteps.is_empty() || self.timesteps == sampler.timesteps)
                && self.solver.is_none_or(|solver| solver == sampler.solver)
                && self.footing.is_none_or(|footing| footing == sampler.footing)
        };
        let meant = measured.iter().filter(|(_, sampler)| as_asked(sampler));
        let meant = measured_with(meant.map(|(name, sampler)| (name.as_str(), sampler))).map_err(|differ| {
            format!(
                "it was evaluated with several samplers: {differ}; choose one with --steps, --guidance, --timesteps, \
                 --solver or --footing"
            )
        })?;
        // If all evaluations use one sampler, the options change that one.
        let all = measured_with(measured.iter().map(|(name, sampler)| (name.as_str(), sampler)));
        let base = meant.or(all.ok().flatten()).cloned().unwrap_or(own);
        let steps = steps.unwrap_or(base.steps);
        let timesteps = match self.timesteps.is_empty() {
            // Another number of steps needs other timesteps.
            true if steps == base.steps => base.timesteps,
            _ => self.timesteps.clone(),
        };
        Ok(Sampler {
            steps,
            guidance: self.guidance.unwrap_or(base.guidance),
            timesteps,
            solver: self.solver.unwrap_or(base.solver),
            footing: self.footing.unwrap_or(base.footing),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sampler(steps: usize, guidance: f64, timesteps: &[usize]) -> Sampler {
        Sampler { steps, guidance, timesteps: timesteps.to_vec(), ..Sampler::default() }
    }

    #[test]
    fn a_model_is_drawn_as_it_was_measured_but_for_what_is_asked() {
        let args = |guidance, timesteps: &[usize]| SamplerArgs {
            guidance,
            timesteps: timesteps.to_vec(),
            solver: None,
            footing: None,
        };
        let own = sampler(2, 6.5, &[999, 499]);
        let of = |args: SamplerArgs, steps| args.sampler(steps, own.clone(), &[]);
        assert_eq!(of(args(None, &[]), None), Ok(own.clone()));
        assert_eq!(of(args(Some(3.0), &[]), Some(2)), Ok(sampler(2, 3.0, &[999, 499])));
        assert_eq!(of(args(None, &[]), Some(4)), Ok(sampler(4, 6.5, &[])), "timesteps are for as many steps");
        assert_eq!(of(args(None, &[699]), None), Ok(sampler(1, 6.5, &[699])), "timesteps say the steps");
        let asked = SamplerArgs { solver: solver("ddim").ok(), ..args(None, &[]) };
        assert_eq!(of(asked, None), Ok(Sampler { solver: Solver::Ddim, ..own.clone() }));
        let asked = SamplerArgs { footing: Some(true), ..args(None, &[]) };
        assert_eq!(of(asked, None), Ok(Sampler { footing: true, ..own.clone() }));
        assert!(solver("euler").unwrap_err().contains("dpm-solver++"), "says which there are");

        let one = |name: &str, sampler| (name.to_owned(), sampler);
        let measured =
            [one("fid", sampler(1, 2.0, &[])), one("t2m_1", sampler(1, 2.0, &[])), one("t2m_4", sampler(4, 2.5, &[]))];
        let of = |steps, measured: &[(String, Sampler)]| args(None, &[]).sampler(steps, own.clone(), measured);
        assert_eq!(of(None, &measured[..2]), Ok(sampler(1, 2.0, &[])));
        assert_eq!(of(Some(8), &measured[..2]), Ok(sampler(8, 2.0, &[])));
        assert_eq!(of(Some(4), &measured), Ok(sampler(4, 2.5, &[])), "the one that was measured with 4 steps");
        let refused = of(None, &measured).unwrap_err();
        assert!(refused.contains("`t2m_4`") && refused.contains("--steps"), "{refused}");
    }
}
