//! Advice on settings of a valid pipeline that are probably mistakes. It is printed before a run and refuses nothing.

use pipeline::{Pipeline, PipelineStage};
use protocol::units::grouped;

/// Returns one sentence for each setting that is probably a mistake.
pub(crate) fn advice(pipeline: &Pipeline) -> Vec<String> {
    let warmups = pipeline.stages.iter().filter_map(long_warmup);
    warmups.chain(pipeline.stages.iter().filter_map(|stage| untrained_guidance(pipeline, stage))).collect()
}

fn long_warmup(stage: &PipelineStage) -> Option<String> {
    let training = stage.settings.training()?;
    let (warmup, steps) = (training.warmup.0, training.steps.0);
    (warmup >= steps && warmup > 0).then(|| {
        let (name, shorter) = (&stage.name, (steps / 10).max(1));
        format!(
            "stage `{name}` warms up for {} of {} steps, so its learning rate never reaches `lr`; `--set \
             stages.{name}.warmup={shorter}` shortens the warm-up",
            grouped(warmup),
            grouped(steps)
        )
    })
}

fn untrained_guidance(pipeline: &Pipeline, stage: &PipelineStage) -> Option<String> {
    let guidance = stage.settings.sampler()?.guidance;
    let measured = stage.settings.evaluated_model()?;
    let model = pipeline.stages.iter().find(|stage| stage.name.as_str() == measured)?;
    let (low, high) = model.settings.family()?.exceeded_range(guidance)?;
    let name = &stage.name;
    Some(format!(
        "stage `{name}` samples `{measured}` at guidance {guidance}, but `{measured}` is trained for {low} to {high}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn advice_of(warmup: u64, guidance: f64) -> Vec<String> {
        let text = format!(
            "name: p\ndataset: {{format: synthetic}}\nstages:\n  vae: {{kind: train.vae}}\n  latents: {{kind: encode.latents}}\n  \
             mld: {{kind: train.mld, steps: 300, warmup: {warmup}}}\n  lcm: {{kind: distill.lcm, guidance: [0.5, 5]}}\n  \
             fid: {{kind: evaluate.latent_fid, model: lcm, sampler: {{steps: 1, guidance: {guidance}}}}}\n"
        );
        advice(&pipeline::read("p.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}")))
    }

    #[test]
    fn what_is_probably_not_meant_is_said() {
        assert_eq!(advice_of(30, 2.0), [""; 0]);
        let said = advice_of(1000, 40.0);
        assert_eq!(
            said,
            [
                "stage `mld` warms up for 1,000 of 300 steps, so its learning rate never reaches `lr`; `--set \
                 stages.mld.warmup=30` shortens the warm-up",
                "stage `fid` samples `lcm` at guidance 40, but `lcm` is trained for 0.5 to 5",
            ]
        );
    }

    #[test]
    fn the_shipped_pipelines_need_no_advice() {
        let configs = cluster_tests::Bench::repository().join("configs");
        for entry in std::fs::read_dir(configs).expect("a folder") {
            let path = entry.expect("an entry").path();
            let text = std::fs::read_to_string(&path).expect("a pipeline");
            let pipeline = pipeline::read("p.yaml", &text, &[]).unwrap_or_else(|mistakes| panic!("{mistakes}"));
            assert_eq!(advice(&pipeline), [""; 0], "{}", path.display());
        }
    }
}
