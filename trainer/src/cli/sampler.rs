//! How a command draws from a model: as the model was measured, but for what the user asks otherwise.

use clap::Args;
use protocol::stage::{Sampler, Solver, measured_with};

/// Parts of a sampler, besides its steps.
#[derive(Debug, Args)]
pub(super) struct SamplerArgs {
    /// Guidance: a teacher's scale g, a student's w = g - 1 [default: as the model was measured]
    #[arg(long, value_name = "W", value_parser = guidance, allow_negative_numbers = true)]
    guidance: Option<f64>,
    /// Timesteps of an LCM student, noisiest first, such as 999,499 [default: as the model was measured]
    #[arg(long, value_name = "T", value_delimiter = ',')]
    timesteps: Vec<usize>,
    /// What follows the predictions: ddpm, ddim, dpm-solver, dpm-solver++, sde-dpm-solver++ [default: as the model was measured]
    #[arg(long, value_name = "SOLVER", value_parser = solver)]
    solver: Option<Solver>,
    /// Whether the root goes where standing feet let it: true or false [default: as the model was measured]
    #[arg(long, value_name = "BOOL")]
    footing: Option<bool>,
}

/// A scale that classifier-free guidance has.
fn guidance(text: &str) -> Result<f64, String> {
    let scale: f64 = text.parse().map_err(|_| "expected a number, such as 2.5".to_owned())?;
    if scale.is_finite() && scale >= 0.0 {
        return Ok(scale);
    }
    Err("expected 0 or more; the larger it is, the closer a motion follows its sentence".to_owned())
}

/// A solver by its word in settings.
fn solver(word: &str) -> Result<Solver, String> {
    serde_json::from_value(word.into()).map_err(|e| e.to_string())
}

impl SamplerArgs {
    /// The sampler to draw with. `own` is the model's; of what a stage gave, `measured` are the evaluations of it, and the one that draws
    /// as it is asked for, if there is one only, takes its place.
    ///
    /// # Errors
    /// The model was measured in several ways, and nobody says which is meant.
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
                "it was measured in several ways: {differ}; say which with --steps, --guidance, --timesteps, --solver or --footing"
            )
        })?;
        // What was measured in one way only is drawn that way but for what is asked.
        let all = measured_with(measured.iter().map(|(name, sampler)| (name.as_str(), sampler)));
        let base = meant.or(all.ok().flatten()).cloned().unwrap_or(own);
        let steps = steps.unwrap_or(base.steps);
        let timesteps = match self.timesteps.is_empty() {
            // Another number of steps has other timesteps.
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
