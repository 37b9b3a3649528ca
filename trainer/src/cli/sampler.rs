//! Sampler of a command: the one of the model's evaluation, with the user's changes.

use clap::Args;
use protocol::stage::{Sampler, Solver, measured_with};

/// Parts of a sampler, besides its steps.
#[derive(Debug, Args)]
pub(super) struct SamplerArgs {
    /// Guidance: a teacher's scale g, a student's w = g - 1 [default: as in the model's evaluation]
    #[arg(long, value_name = "W", value_parser = guidance, allow_negative_numbers = true, help_heading = "Sampling")]
    guidance: Option<f64>,
    /// A rarer setting, may be repeated: timesteps=999,499 of an LCM student, noisiest first; solver=ddpm, ddim,
    /// dpm-solver, dpm-solver++ or sde-dpm-solver++; footing=true or false, which corrects foot sliding by moving the
    /// root [default: as in the model's evaluation]
    #[arg(long = "sampler", value_name = "KEY=VALUE", value_parser = rare, help_heading = "Sampling")]
    rare: Vec<Rare>,
}

/// The settings of `--sampler`; of a repeated one, the last counts.
#[derive(Debug, Default)]
struct Asked<'a> {
    timesteps: &'a [usize],
    solver: Option<Solver>,
    footing: Option<bool>,
}

/// A setting of `--sampler`.
#[derive(Debug, Clone, PartialEq)]
enum Rare {
    Timesteps(Vec<usize>),
    Solver(Solver),
    Footing(bool),
}

/// Parses `KEY=VALUE`.
fn rare(text: &str) -> Result<Rare, String> {
    const KEYS: [&str; 3] = ["timesteps", "solver", "footing"];
    let Some((key, value)) = text.split_once('=') else {
        return Err("expected KEY=VALUE, such as solver=ddim".to_owned());
    };
    match key {
        "timesteps" => {
            let numbers: Result<Vec<usize>, _> = value.split(',').map(|number| number.trim().parse()).collect();
            numbers.map(Rare::Timesteps).map_err(|_| format!("`{value}` is no list of timesteps, such as 999,499"))
        }
        "solver" => solver(value).map(Rare::Solver),
        "footing" => value.parse().map(Rare::Footing).map_err(|_| format!("`{value}` is neither true nor false")),
        "steps" | "guidance" => Err(format!("`{key}` has an option of its own: --{key} {value}")),
        other => {
            let meant = protocol::spelling::question(other, KEYS);
            Err(format!("expected one of {}; there is no setting `{other}`{meant}", KEYS.join(", ")))
        }
    }
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
    serde_json::from_value(word.into()).map_err(|error| match error.to_string().split_once(", expected") {
        Some((_, expected)) => format!("there is no solver `{word}`; expected{expected}"),
        None => error.to_string(),
    })
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
        let asked = self.asked();
        let steps = steps.or((!asked.timesteps.is_empty()).then_some(asked.timesteps.len()));
        let as_asked = |sampler: &Sampler| {
            steps.is_none_or(|steps| steps == sampler.steps)
                && self.guidance.is_none_or(|guidance| guidance == sampler.guidance)
                && (asked.timesteps.is_empty() || asked.timesteps == sampler.timesteps)
                && asked.solver.is_none_or(|solver| solver == sampler.solver)
                && asked.footing.is_none_or(|footing| footing == sampler.footing)
        };
        let meant = measured.iter().filter(|(_, sampler)| as_asked(sampler));
        let meant = measured_with(meant.map(|(name, sampler)| (name.as_str(), sampler))).map_err(|differ| {
            format!(
                "it was evaluated with several samplers: {differ}; choose one with --steps, --guidance or \
                 --sampler"
            )
        })?;
        // If all evaluations use one sampler, the options change that one.
        let all = measured_with(measured.iter().map(|(name, sampler)| (name.as_str(), sampler)));
        let base = meant.or(all.ok().flatten()).cloned().unwrap_or(own);
        let steps = steps.unwrap_or(base.steps);
        let timesteps = match asked.timesteps.is_empty() {
            // Another number of steps needs other timesteps.
            true if steps == base.steps => base.timesteps,
            _ => asked.timesteps.to_vec(),
        };
        Ok(Sampler {
            steps,
            guidance: self.guidance.unwrap_or(base.guidance),
            timesteps,
            solver: asked.solver.unwrap_or(base.solver),
            footing: asked.footing.unwrap_or(base.footing),
        })
    }

    fn asked(&self) -> Asked<'_> {
        let mut asked = Asked::default();
        for setting in &self.rare {
            match setting {
                Rare::Timesteps(timesteps) => asked.timesteps = timesteps,
                Rare::Solver(solver) => asked.solver = Some(*solver),
                Rare::Footing(footing) => asked.footing = Some(*footing),
            }
        }
        asked
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
        let args = |guidance, timesteps: &[usize]| {
            let rare = (!timesteps.is_empty()).then(|| Rare::Timesteps(timesteps.to_vec()));
            SamplerArgs { guidance, rare: rare.into_iter().collect() }
        };
        let with = |rare: &[Rare]| SamplerArgs { guidance: None, rare: rare.to_vec() };
        let own = sampler(2, 6.5, &[999, 499]);
        let of = |args: SamplerArgs, steps| args.sampler(steps, own.clone(), &[]);
        assert_eq!(of(args(None, &[]), None), Ok(own.clone()));
        assert_eq!(of(args(Some(3.0), &[]), Some(2)), Ok(sampler(2, 3.0, &[999, 499])));
        assert_eq!(of(args(None, &[]), Some(4)), Ok(sampler(4, 6.5, &[])), "timesteps are for as many steps");
        assert_eq!(of(args(None, &[699]), None), Ok(sampler(1, 6.5, &[699])), "timesteps say the steps");
        let ddim = Rare::Solver(Solver::Ddim);
        assert_eq!(of(with(std::slice::from_ref(&ddim)), None), Ok(Sampler { solver: Solver::Ddim, ..own.clone() }));
        let asked = with(&[Rare::Footing(false), Rare::Footing(true)]);
        assert_eq!(of(asked, None), Ok(Sampler { footing: true, ..own.clone() }), "the last one counts");
        let asked = with(&[ddim, Rare::Timesteps(vec![7])]);
        assert_eq!(of(asked, None), Ok(Sampler { solver: Solver::Ddim, ..sampler(1, 6.5, &[7]) }));
        assert_eq!(rare("footing=false"), Ok(Rare::Footing(false)));
        assert!(rare("solvr=ddim").unwrap_err().contains("did you mean `solver`?"));
        assert!(rare("guidance=3").unwrap_err().contains("--guidance 3"));
        assert!(rare("ddim").is_err() && rare("timesteps=soon").is_err() && rare("footing=maybe").is_err());
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
