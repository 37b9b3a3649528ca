//! Samplers of models: settings, the samplers that a family supports, and the default of a model.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Problems;
use crate::units::counted;

/// Number of timesteps of every published noise schedule.
const TIMESTEPS: usize = 1000;

/// The method that turns noise into a motion by a model's predictions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum Solver {
    /// The solver of the model's paper: DDIM (MLD), ancestral sampling (MDM), the stochastic DPM-Solver++
    /// (StableMoFusion), jumps (students).
    #[default]
    #[serde(rename = "own")]
    Own,
    /// Ancestral sampling: fresh noise in every step.
    #[serde(rename = "ddpm")]
    Ddpm,
    /// Deterministic; spaced as in MLD in latent space, as in StableMoFusion for features.
    #[serde(rename = "ddim")]
    Ddim,
    /// Deterministic, second order, on the predicted noise.
    #[serde(rename = "dpm-solver")]
    DpmSolver,
    /// Deterministic, second order, on the predicted sample.
    #[serde(rename = "dpm-solver++")]
    DpmSolverPp,
    /// Second order with fresh noise, on the noise levels of Karras et al.; the last step returns the sample.
    #[serde(rename = "sde-dpm-solver++")]
    SdeDpmSolverPp,
    /// The same as in libraries of 2023: the last noise level is repeated, so that the last step changes nothing.
    #[serde(rename = "sde-dpm-solver++-2023")]
    SdeDpmSolverPp2023,
}

impl Solver {
    /// Name in settings and on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Own => "own",
            Self::Ddpm => "ddpm",
            Self::Ddim => "ddim",
            Self::DpmSolver => "dpm-solver",
            Self::DpmSolverPp => "dpm-solver++",
            Self::SdeDpmSolverPp => "sde-dpm-solver++",
            Self::SdeDpmSolverPp2023 => "sde-dpm-solver++-2023",
        }
    }
}

/// Settings for sampling from a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Sampler {
    /// Number of network evaluations. A PCM student has as many as phases. A masked token generator makes this many
    /// iterations, MMM's for the longest motion. An autoregressive generator has no number of steps, so this is 1.
    #[schemars(range(min = 1, max = 1_000), extend("x-unit" = "steps"))]
    pub steps: usize,
    /// Guidance scale. Teacher and masked token generator: g in `uncond + g (cond - uncond)`. Student: the embedded w,
    /// which is g - 1. Autoregressive and MMM's generators have none: 0.
    #[schemars(range(min = 0.0, max = 1e3))]
    pub guidance: f64,
    /// For LCM: timesteps, first to last; empty uses evenly spaced points of the training grid from 999 down.
    #[schemars(inner(range(min = 0, max = 999)))]
    pub timesteps: Vec<usize>,
    /// Solver from noise to a motion.
    pub solver: Solver,
    /// Corrects the root path of a generated motion so that standing feet do not slide (ours). Target positions have
    /// priority, and an edited motion keeps the path of its kept frames.
    pub footing: bool,
}

impl Default for Sampler {
    fn default() -> Self {
        Self { steps: 1, guidance: 7.5, timesteps: Vec::new(), solver: Solver::Own, footing: false }
    }
}

impl std::fmt::Display for Sampler {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}, guidance {}", counted(self.steps, "step"), self.guidance)?;
        if self.solver != Solver::Own {
            write!(f, ", {}", self.solver.name())?;
        }
        if self.footing {
            write!(f, ", feet held")?;
        }
        match self.timesteps.is_empty() {
            true => Ok(()),
            false => write!(f, ", timesteps {:?}", self.timesteps),
        }
    }
}

impl Sampler {
    /// Checks that apply to every model.
    pub(super) fn check(&self, p: &mut Problems) {
        if !(1..=TIMESTEPS).contains(&self.steps) {
            p.add("sampler.steps", format!("`sampler.steps` is {}; expected 1 to {TIMESTEPS}", self.steps), "");
        }
        p.not_negative("sampler.guidance", self.guidance);
        if let Some(t) = self.timesteps.iter().find(|t| **t >= TIMESTEPS) {
            let last = TIMESTEPS - 1;
            p.add("sampler.timesteps", format!("timestep {t} is out of range; expected 0 to {last}"), "");
        }
        if self.timesteps.windows(2).any(|pair| pair[0] < pair[1]) {
            p.add(
                "sampler.timesteps",
                "`sampler.timesteps` are not in descending order; expected the noisiest first",
                "",
            );
        }
        if !self.timesteps.is_empty() && self.timesteps.len() != self.steps {
            let entries = self.timesteps.len();
            let message = format!("`sampler.timesteps` has {entries} entries, but `sampler.steps` is {}", self.steps);
            p.add("sampler.timesteps", message, "");
        }
    }
}

/// Family of a model, which decides its samplers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "family", rename_all = "lowercase")]
pub enum Family {
    /// Predicts noise; DDIM with classifier-free guidance.
    Mld,
    /// Latent consistency model: jumps to the data, re-noises between jumps.
    Lcm {
        /// Solver step k; the grid has 1000/k points.
        skip: usize,
        /// Guidance scales w it was trained for.
        guidance: (f64, f64),
    },
    /// Phased consistency model: deterministic jumps between phase edges.
    Pcm {
        /// Solver step k; the grid has 1000/k points.
        skip: usize,
        /// Guidance scales w it was trained for.
        guidance: (f64, f64),
        /// M: phases, and sampling steps.
        phases: usize,
    },
    /// Draws tokens one after the other, and so decides the length of a motion.
    Autoregressive,
    /// Draws all tokens at once in several iterations, with classifier-free guidance.
    Masked,
    /// Draws all tokens at once in several iterations as MMM does, without guidance.
    Mmm,
    /// Diffuses motion itself, without latents; classifier-free guidance.
    Features {
        /// Number of timesteps of its noise schedule.
        timesteps: usize,
        /// The published solver.
        solver: Solver,
    },
}

impl Family {
    /// Returns true for a student: guidance is built in, so it cannot run without and cannot be a teacher.
    pub fn is_student(&self) -> bool {
        matches!(self, Self::Lcm { .. } | Self::Pcm { .. })
    }

    /// The range of guidance that a student was trained for, if `guidance` lies outside of it.
    pub fn exceeded_range(&self, guidance: f64) -> Option<(f64, f64)> {
        match self {
            Self::Lcm { guidance: (low, high), .. } | Self::Pcm { guidance: (low, high), .. } => {
                (!(*low..=*high).contains(&guidance)).then_some((*low, *high))
            }
            Self::Mld | Self::Autoregressive | Self::Masked | Self::Mmm | Self::Features { .. } => None,
        }
    }

    /// Returns true if it generates tokens.
    pub fn draws_tokens(&self) -> bool {
        matches!(self, Self::Autoregressive | Self::Masked | Self::Mmm)
    }

    /// Returns true if it generates latents of a VAE.
    pub fn draws_latents(&self) -> bool {
        matches!(self, Self::Mld | Self::Lcm { .. } | Self::Pcm { .. })
    }

    /// Resolves `solver` for a model of this family; `None` if the family does not support it.
    pub fn solver(&self, solver: Solver) -> Option<Solver> {
        match (self, solver) {
            (Self::Lcm { .. } | Self::Pcm { .. } | Self::Autoregressive | Self::Masked | Self::Mmm, solver) => {
                (solver == Solver::Own).then_some(Solver::Own)
            }
            (Self::Mld, Solver::Own) => Some(Solver::Ddim),
            (Self::Mld, Solver::Ddim | Solver::DpmSolver | Solver::DpmSolverPp) => Some(solver),
            (Self::Mld, _) => None,
            (Self::Features { solver: own, .. }, Solver::Own) => Some(*own),
            (Self::Features { .. }, solver) => Some(solver),
        }
    }

    /// Checks a sampler for a model of this family; `model` is its name in messages.
    pub(super) fn check(&self, model: &str, sampler: &Sampler, p: &mut Problems) {
        let steps = sampler.steps;
        if matches!(self, Self::Autoregressive | Self::Mmm) && sampler.guidance != 0.0 {
            let message = format!("`sampler.guidance` is {}, but {model} has no guidance", sampler.guidance);
            p.add("sampler.guidance", message, "write `guidance: 0`");
        }
        if !sampler.timesteps.is_empty() && !matches!(self, Self::Lcm { .. }) {
            let message = format!("`sampler.timesteps` are for LCM students, and {model} is not one");
            p.add("sampler.timesteps", message, "remove them");
        }
        if self.solver(sampler.solver).is_none() {
            let message = format!("`sampler.solver` is `{}`, which {model} does not have", sampler.solver.name());
            let help = match self {
                Self::Mld => "use `ddim`, `dpm-solver` or `dpm-solver++`",
                Self::Autoregressive | Self::Masked | Self::Mmm => "a token generator has no solver; remove the key",
                _ => "a student has no solver; remove the key",
            };
            p.add("sampler.solver", message, help);
        }
        let mut at_most = |most: usize, what: &str| {
            if steps > most {
                p.add("sampler.steps", format!("`sampler.steps` is {steps}, but {what}; expected 1 to {most}"), "");
            }
        };
        match self {
            Self::Mld => at_most(TIMESTEPS - 1, "there are no more timesteps between noise and data"),
            Self::Lcm { skip, .. } if sampler.timesteps.is_empty() => {
                let points = TIMESTEPS / (*skip).max(1);
                at_most(points, &format!("the grid of {model} has {points} points"));
            }
            Self::Lcm { .. } | Self::Masked | Self::Mmm => {}
            Self::Features { timesteps, solver } => {
                let solver = if sampler.solver == Solver::Own { *solver } else { sampler.solver };
                // A deterministic path has one level more than moves.
                let even = matches!(solver, Solver::DpmSolver | Solver::DpmSolverPp);
                at_most(timesteps - usize::from(even && *timesteps > 1), &format!("{model} has {timesteps} timesteps"));
            }
            Self::Autoregressive => {
                at_most(1, &format!("{model} generates one token after another until the motion ends"));
            }
            // A number of phases that is wrong itself suggests no number of steps.
            Self::Pcm { phases, .. } if *phases == steps || *phases == 0 => {}
            Self::Pcm { phases, .. } => {
                let message = format!(
                    "`sampler.steps` is {steps}, but {model} has {}; a PCM student takes one step per phase",
                    counted(*phases, "phase")
                );
                p.add("sampler.steps", message, &format!("write `steps: {phases}`"));
            }
        }
    }

    /// Checks `sampler` for this family like a pipeline's check, with all problems in one line.
    ///
    /// # Errors
    /// All problems.
    pub fn accepts(&self, sampler: &Sampler) -> Result<(), String> {
        let mut problems = Problems::default();
        sampler.check(&mut problems);
        self.check("the model", sampler, &mut problems);
        let reasons: Vec<String> = problems.0.into_iter().map(|problem| problem.message).collect();
        if reasons.is_empty() { Ok(()) } else { Err(reasons.join("; ")) }
    }

    /// Samplers of the papers. A teacher has 50 steps at its published guidance. A student has as many steps as phases
    /// (an LCM has one), at a third of its range of guidance scales. MoMask has ten steps at 4, MMM ten; MDM has all
    /// its timesteps and StableMoFusion ten steps, both at 2.5. The published range 5 to 15 gives w = 8.3, near
    /// MotionLCM's 7 to 12.5. For models without an evaluation; others use that of their evaluation.
    pub fn published(&self) -> Sampler {
        let student = |steps: usize, (low, high): (f64, f64)| Sampler {
            steps,
            guidance: low + (high - low) / 3.0,
            ..Sampler::default()
        };
        match self {
            Self::Mld => Sampler { steps: 50, guidance: 7.5, ..Sampler::default() },
            Self::Autoregressive => Sampler { steps: 1, guidance: 0.0, ..Sampler::default() },
            Self::Masked => Sampler { steps: 10, guidance: 4.0, ..Sampler::default() },
            Self::Mmm => Sampler { steps: 10, guidance: 0.0, ..Sampler::default() },
            Self::Lcm { guidance, .. } => student(1, *guidance),
            Self::Pcm { guidance, phases, .. } => student(*phases, *guidance),
            Self::Features { timesteps, solver } => {
                let steps = if *solver == Solver::Ddpm { *timesteps } else { 10.min(*timesteps) };
                Sampler { steps, guidance: 2.5, ..Sampler::default() }
            }
        }
    }
}

/// The only sampler among the evaluations of a model, by name; `None` if there are no evaluations.
///
/// # Errors
/// The evaluations that differ, and their difference.
pub fn measured_with<'a>(
    evaluations: impl IntoIterator<Item = (&'a str, &'a Sampler)>,
) -> Result<Option<&'a Sampler>, String> {
    let mut groups: Vec<(&Sampler, Vec<&str>)> = Vec::new();
    for (name, sampler) in evaluations {
        match groups.iter_mut().find(|(known, _)| *known == sampler) {
            Some((_, names)) => names.push(name),
            None => groups.push((sampler, vec![name])),
        }
    }
    if groups.len() < 2 {
        return Ok(groups.first().map(|(sampler, _)| *sampler));
    }
    let each = groups.iter().map(|(sampler, names)| format!("{sampler} in `{}`", names.join("`, `")));
    Err(each.collect::<Vec<_>>().join("; "))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sampler(steps: usize, timesteps: &[usize]) -> Sampler {
        Sampler { steps, guidance: 2.0, timesteps: timesteps.to_vec(), ..Sampler::default() }
    }

    #[test]
    fn samplers_that_a_family_does_not_have_are_refused() {
        let lcm = Family::Lcm { skip: 100, guidance: (5.0, 15.0) };
        let pcm = Family::Pcm { skip: 100, guidance: (5.0, 15.0), phases: 2 };
        for (family, sampler, word) in [
            (&Family::Mld, sampler(0, &[]), "steps"),
            (&Family::Mld, sampler(1000, &[]), "1 to 999"),
            (&Family::Mld, sampler(1, &[999]), "timesteps"),
            (&lcm, sampler(11, &[]), "1 to 10"),
            (&lcm, sampler(2, &[999]), "timesteps"),
            (&lcm, sampler(1, &[1000]), "0 to 999"),
            (&pcm, sampler(1, &[]), "2 phase"),
            (&pcm, sampler(2, &[999, 499]), "timesteps"),
            (&pcm, Sampler { guidance: f64::NAN, ..sampler(2, &[]) }, "guidance"),
        ] {
            let refused = family.accepts(&sampler).unwrap_err();
            assert!(refused.contains(word), "{refused}");
        }
        let mdm = Family::Features { timesteps: 50, solver: Solver::Ddpm };
        let solved = |solver, steps| Sampler { solver, ..sampler(steps, &[]) };
        for (family, sampler, word) in [
            (&lcm, solved(Solver::Ddim, 1), "a student has no solver"),
            (&Family::Mld, solved(Solver::SdeDpmSolverPp, 10), "`sde-dpm-solver++`"),
            (&mdm, sampler(51, &[]), "1 to 50"),
            (&mdm, solved(Solver::DpmSolverPp, 50), "1 to 49"),
            (&mdm, sampler(1, &[49]), "timesteps"),
        ] {
            let mut problems = Problems::default();
            family.check("the model", &sampler, &mut problems);
            let said = format!("{:?}", problems.0);
            assert!(said.contains(word), "{said}");
        }
        assert_eq!(mdm.accepts(&solved(Solver::Ddim, 50)), Ok(()));
        assert_eq!(Family::Mld.accepts(&solved(Solver::DpmSolverPp, 10)), Ok(()));
        assert_eq!(Family::Mld.accepts(&sampler(50, &[])), Ok(()));
        assert_eq!(lcm.accepts(&sampler(2, &[699, 299])), Ok(()));
        assert_eq!(pcm.accepts(&sampler(2, &[])), Ok(()));
        for family in [Family::Autoregressive, Family::Mmm] {
            assert!(family.accepts(&sampler(1, &[])).unwrap_err().contains("has no guidance"), "{family:?}");
        }
        for family in [Family::Mld, lcm, pcm, mdm, Family::Autoregressive, Family::Masked, Family::Mmm] {
            assert_eq!(family.accepts(&family.published()), Ok(()), "{family:?}");
        }
    }

    #[test]
    fn guidance_outside_of_a_student_s_training_is_known() {
        let lcm = Family::Lcm { skip: 100, guidance: (0.5, 5.0) };
        assert_eq!([0.5, 2.0, 5.0].map(|guidance| lcm.exceeded_range(guidance)), [None; 3]);
        assert_eq!([0.0, 40.0].map(|guidance| lcm.exceeded_range(guidance)), [Some((0.5, 5.0)); 2]);
        assert_eq!(Family::Mld.exceeded_range(40.0), None, "a teacher has no range");
    }

    #[test]
    fn what_a_model_was_measured_with_is_one_sampler_or_a_question() {
        let one = sampler(1, &[]);
        let four = sampler(4, &[]);
        assert_eq!(measured_with([]), Ok(None));
        assert_eq!(measured_with([("fid", &one), ("t2m", &one.clone())]), Ok(Some(&one)));
        let refused = measured_with([("fid", &one), ("t2m_1", &one), ("t2m_4", &four)]).unwrap_err();
        assert_eq!(refused, "1 step, guidance 2 in `fid`, `t2m_1`; 4 steps, guidance 2 in `t2m_4`");
    }
}
