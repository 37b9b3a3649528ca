//! Messages to users about measures: times, and mistakes in a metric, a split or an evaluator.

use cluster_tests::Bench;

const TRAINER: &str = env!("CARGO_BIN_EXE_trainer");

/// All checks share one smoke run, whose stages are cached afterwards.
#[test]
fn measures_are_taken_and_misused_with_the_reason() {
    let bench = Bench::new(TRAINER);
    let report = bench.pipeline("smoke.yaml", &[]);
    let of = |stage: &str| {
        let found = report["stages"].as_array().and_then(|all| all.iter().find(|s| s["name"] == stage));
        found.unwrap_or_else(|| panic!("no stage {stage} in {report:#}"))["metrics"].clone()
    };
    let reconstruction = of("reconstruction");
    for metric in
        ["pa_mpjpe_mm", "acceleration_mm", "sjpe", "sjpe_noise", "sjpe_static", "skating_ratio", "real_skating_ratio"]
    {
        assert!(reconstruction[metric].is_number(), "{metric}: {reconstruction:#}");
    }

    // The teacher by its stage, the student by its name: one row per supported number of steps.
    let time = ["time", "smoke@staging", "--stage", "mld", "--steps", "4,1", "--sentences", "3", "--frames", "40"];
    let said = bench.run(&[&time[..], &["-o", "json"]].concat()).expect_code(0).json();
    let rows = said["rows"].as_array().expect("rows");
    let steps: Vec<_> = rows.iter().map(|row| row["sampler"]["steps"].as_u64()).collect();
    assert!(rows[0]["model"].as_str().is_some_and(|m| m.starts_with("mld of ")) && rows[0]["ratio"] == 1.0, "{said}");
    assert!(steps[..2] == [Some(4), Some(1)] && steps.len() >= 3, "{said}");
    for row in rows {
        assert!(row["sentences"] == 3 && row["aits_s"].as_f64().is_some_and(|s| s > 0.0), "{said}");
    }
    let table = bench.run(&time).expect_code(0).stdout;
    println!("{table}");
    assert!(table.contains("AITS") && table.contains("3 sentences") && table.contains("threads"), "{table}");
    let unknown = bench.run(&["time", "--stage", "vae"]).expect_code(7).stderr;
    assert!(unknown.contains("no model") && unknown.contains("mld"), "{unknown}");
    bench.run(&["time"]).expect_code(2);
    models_are_drawn_as_they_were_measured(&bench);

    // A mistake that only the data reveals stops one stage. The message explains it and names the stage once.
    let config = Bench::config("smoke.yaml");
    let said = bench.run(&["run", &config, "--set", "stages.t2m_real.split=test"]).expect_code(1).stderr;
    assert!(["the split `test` has", "pools of 32", "split: all"].iter().all(|part| said.contains(part)), "{said}");
    let error = said.rsplit("error: ").next().expect("an error");
    assert!(error.starts_with("stage `t2m_real` failed: "), "{said}");
    assert_eq!(error.matches("stage `").count(), 1, "the stage is named once:\n{said}");
    // A mistake in the pipeline is refused before anything runs.
    for (set, parts) in [
        ("stages.release.metric=fdi", vec!["reports `fdi`", "`latent_fid`"]),
        ("stages.release.promote.require=[fdi <= 1]", vec!["needs `fdi`", "`latent_fid`"]),
        ("stages.vae.checkpoint={every: 4, keep: {best: 1, metric: fdi}}", vec!["`fdi`", "loss", "joint"]),
    ] {
        for verb in ["plan", "run"] {
            let said = bench.run(&[verb, &config, "--set", set, "--set", "seed=77"]).expect_code(2).stderr;
            assert!(parts.iter().all(|part| said.contains(part)), "{verb} {set}:\n{said}");
        }
    }
    let kit = "stages.judge={kind: import.evaluator, format: kit, path: t2m}";
    let said = bench.run(&["plan", &config, "--set", kit, "--set", "stages.t2m_real.evaluator=judge"]).expect_code(2);
    assert!(said.stderr.contains("21 joints (kit)") && said.stderr.contains("22 joints"), "{}", said.stderr);
}

/// Two models that diffuse motion itself, one of them trained with Free-T2M's losses. They are measured, registered,
/// compared and used like any other.
fn models_of_motion_are_models(bench: &Bench, generate: &dyn Fn(&[&str]) -> serde_json::Value) {
    let config = Bench::config("smoke.yaml");
    let training = "steps: 6, batch: {global: 8, slices: 4}, checkpoint: {every: 2}, lr: 1e-3";
    let losses = "{low_frequency: {weight: 1, from: 0.5}, semantic: {weight: 0.5, to: 0.5, evaluator: semantics}}";
    let mdm = format!(
        "network: {{width: 16, layers: 2, heads: 2, feed_forward: 24}}, timesteps: 8, mask_frames: true, {training}"
    );
    let smf = format!(
        "network: {{width: 16, multipliers: [1, 2], time: 8, text: 8, text_layers: 1, text_heads: 2, text_feed_forward: 12}}, {training}"
    );
    let evaluate = |model: &str, steps: usize| {
        format!(
            "stages.t2m_{model}={{kind: evaluate.t2m, model: {model}, sampler: {{steps: {steps}, guidance: 2.5}}, repeats: 2, \
             multimodality: {{captions: 0}}, split: all, shards: 2}}"
        )
    };
    let register = "stages.motion_release={kind: register, model: motion, from: [free_mdm, smf], sampler: {steps: 4, guidance: 2.5}, metric: fid, mode: min, promote: {to: staging}}";
    let sets = [
        "stages.semantics={kind: train.evaluator, network: {movement: 16, motion: 16, text: 16, embedding: 16}, movement: {until: 0.5, window: 24, batch: 0}, steps: 4, batch: {global: 8, slices: 4}, lr: 1e-3}".to_owned(),
        format!("stages.mdm={{kind: train.mdm, {mdm}}}"),
        format!("stages.free_mdm={{kind: train.mdm, init: mdm, losses: {losses}, {mdm}}}"),
        format!("stages.smf={{kind: train.stablemofusion, {smf}}}"),
        evaluate("free_mdm", 4),
        evaluate("smf", 4),
        register.to_owned(),
    ];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set.as_str()]).collect();
    bench.run(&[&["run", &config], &sets[..]].concat()).expect_code(0);
    let own = generate(&["--model", "motion@staging", "--frames", "44"]);
    assert_eq!((&own["frames"], &own["sampler"]["steps"]), (&44.into(), &4.into()), "{own}");
    generate(&["--stage", "smf", "--frames", "44", "--steps", "3", "--sampler", "solver=ddim"]);
    let shown = bench.run(&["registry", "show", "motion@staging"]).expect_code(0).stdout;
    assert!(shown.contains("feature-diffusion, humanml3d") && shown.contains("denoiser="), "{shown}");
    let time = ["time", "motion@staging", "--sentences", "2", "--frames", "40", "-o", "json"];
    assert!(bench.run(&time).expect_code(0).json()["rows"][0]["aits_s"].is_number());
    let flattered = ["--set", "stages.t2m_free_mdm.evaluator=semantics"];
    let refused = bench.run(&[&["run", &config], &sets[..], &flattered[..]].concat()).expect_code(2).stderr;
    assert!(refused.contains("would be biased"), "{refused}");
}

/// Students with a control part are measured, registered beside their bases, and given target positions.
fn motion_goes_where_it_is_told(bench: &Bench, generate: &dyn Fn(&[&str]) -> serde_json::Value) {
    let config = Bench::config("smoke.yaml");
    let control = |base: &str| {
        format!(
            "stages.on_{base}={{kind: train.control, model: {base}, hints: {{setting: spatial, joints: [pelvis, left_wrist], density: [0, 100]}}, \
             guidance: [0.5, 5], network: {{width: 32, layers: 3, heads: 2, feed_forward: 64}}, embedding: 16, steps: 6, \
             batch: {{global: 8, slices: 4}}, checkpoint: {{every: 2}}, lr: 1e-3}}"
        )
    };
    let evaluate = |base: &str| {
        format!(
            "stages.told_{base}={{kind: evaluate.control, model: on_{base}, setting: spatial, joints: [pelvis, six], percent: [25], frames: [2], \
             sampler: {{steps: 1, guidance: 2.5}}, repeats: 2, split: all, shards: 2}}"
        )
    };
    let register = |base: &str| {
        format!(
            "stages.out_{base}={{kind: register, model: on-{base}, from: on_{base}, metric: average_error, promote: {{to: staging, \
             require: [\"average_error < 1000\", \"average_error/pelvis/2frames < 1000\"]}}}}"
        )
    };
    let sets: Vec<String> = ["lcm", "pcm"].iter().flat_map(|b| [control(b), evaluate(b), register(b)]).collect();
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set.as_str()]).collect();
    bench.run(&[&["run", &config], &sets[..]].concat()).expect_code(0);
    let shown = bench.run(&["registry", "show", "on-lcm@staging"]).expect_code(0).stdout;
    for part in ["control=", "control for denoiser=", "denoiser for text=", "average_error/six/25pct"] {
        assert!(shown.contains(part), "`{part}` is missing in\n{shown}");
    }

    let path = |text: &str| {
        let file = bench.path().join("path.csv");
        std::fs::write(&file, text).expect("the path is written");
        file.display().to_string()
    };
    let told = path("t,joint,x,y,z\n0,pelvis,0,0.9,0\n1,pelvis,0,0.9,1\n2,left_wrist,0.3,1.2,2\n");
    let drawn = generate(&["--model", "on-lcm@staging", "--control", &told]);
    assert_eq!((&drawn["control"]["told"], &drawn["frames"]), (&3.into(), &44.into()), "{drawn}");
    assert!(drawn["control"]["average_error_m"].as_f64().is_some_and(|error| error > 0.0), "{drawn}");
    let one = generate(&["--stage", "on_pcm", "--control", &told, "--joints", "pelvis", "--control-scale", "0.5"]);
    assert_eq!(one["control"]["told"], 2, "{one}");
    let whole = bench.path().join("x.npy").display().to_string();
    let again = generate(&["--model", "on-lcm@staging", "--control", &whole, "--joints", "pelvis,head"]);
    assert_eq!((&again["control"]["told"], &again["frames"]), (&80.into(), &40.into()), "two joints, {again}");
    let sheet = ["generate", "a person walks", "--model", "on-lcm@staging", "--control", &told, "-o", "x.png"];
    let said = bench.run(&sheet).expect_code(0).stdout;
    assert!(said.contains("3 target positions"), "{said}");

    let fast = "t,x,y,z\n0,0,0.9,0\n0.1,0,0.9,5\n";
    for (text, args, words) in [
        ("t,x,y,z\n9.95,0,0.9,0\n", vec!["--model", "on-lcm@staging", "--frames", "60"], ["9.95 s", "60 frames"]),
        ("t,x,y,z\n900,0,0.9,0\n", vec!["--model", "on-lcm@staging"], ["900", "at most"]),
        ("t,x,y,z\n0,0,0.9,0\n", vec!["--model", "on-lcm@staging", "--joints", "tail"], ["`tail`", "left_wrist"]),
        (fast, vec!["--model", "on-lcm@staging"], ["line 3", "50.0 m/s"]),
        ("t,x,y,z\n0,0,0.9,0\n", vec!["--stage", "lcm"], ["has no control part", "train.control"]),
        (
            "t,x,y,z\n0,0,0.9,0\n",
            vec!["--stage", "lcm", "--control-from", "on-pcm@staging"],
            ["`control` was trained with the `denoiser`", "registry show"],
        ),
    ] {
        let file = path(text);
        let line = [&["generate", "a person walks", "-o", "x.npy", "--control", &file], &args[..]].concat();
        let said = bench.run(&line).expect_code(2).stderr;
        assert!(words.iter().all(|word| said.contains(word)), "{args:?}: {said}");
    }
    generate(&["--stage", "lcm", "--control-from", "on-lcm@staging", "--control", &path("t,x,y,z\n0,0,0.9,0\n")]);
    let kit = ["--set", "stages.on_lcm.hints.joints=[right_midfoot]"];
    let refused = bench.run(&[&["plan", &config], &sets[..], &kit[..]].concat()).expect_code(2).stderr;
    assert!(refused.contains("has no joint `right_midfoot`"), "{refused}");
}

/// A promoted student and a stage's model use the sampler of their evaluations, which is not the papers'.
fn models_are_drawn_as_they_were_measured(bench: &Bench) {
    let config = Bench::config("smoke.yaml");
    let generate = |args: &[&str]| {
        let line = [&["generate", "a person walks", "-o", "x.npy", "--report", "json"], args].concat();
        bench.run(&line).expect_code(0).json()
    };
    let features = || std::fs::read(bench.path().join("x.npy")).expect("the motion is written");
    let own = generate(&["--model", "smoke@staging"]);
    assert_eq!(
        own["sampler"],
        serde_json::json!({"steps": 1, "guidance": 2.5, "timesteps": [], "solver": "own", "footing": false}),
        "{own}"
    );
    let drawn = features();
    generate(&["--model", "smoke@staging", "--steps", "1", "--guidance", "2.5"]);
    assert_eq!(drawn, features(), "what was measured, said again");
    generate(&["--model", "smoke@staging", "--guidance", "2"]);
    assert_ne!(drawn, features(), "what the papers' rule would give");
    let shown = bench.run(&["registry", "show", "smoke@staging"]).expect_code(0).stdout;
    for part in ["latent-diffusion, humanml3d", "1 step, guidance 2.5", "denoiser=", "text=", "vae="] {
        assert!(shown.contains(part), "`{part}` is missing in\n{shown}");
    }

    let teacher = generate(&["--stage", "mld"]);
    assert_eq!((&teacher["sampler"]["steps"], &teacher["sampler"]["guidance"]), (&4.into(), &3.0.into()), "{teacher}");
    let started = generate(&["--stage", "lcm", "--sampler", "timesteps=799"]);
    assert_eq!(
        started["sampler"],
        serde_json::json!({"steps": 1, "guidance": 2.5, "timesteps": [799], "solver": "own", "footing": false}),
        "{started}"
    );
    let refused =
        bench.run(&["generate", "x", "--stage", "pcm", "--sampler", "timesteps=799", "-o", "x.npy"]).expect_code(2);
    assert!(refused.stderr.contains("LCM students"), "{}", refused.stderr);
    let solved = generate(&["--stage", "mld", "--sampler", "solver=dpm-solver++"]);
    assert_eq!(solved["sampler"]["solver"], "dpm-solver++", "{solved}");
    models_of_motion_are_models(bench, &generate);
    motion_goes_where_it_is_told(bench, &generate);

    // Evaluations that differ, and the one that `register` names.
    let other = ["--set", "stages.t2m_pcm.sampler.guidance=3"];
    let refused = bench.run(&[&["run", &config], &other[..]].concat()).expect_code(2).stderr;
    assert!(refused.contains("guidance 2.5 in `fid_pcm`; 1 step, guidance 3 in `t2m_pcm`"), "{refused}");
    let length = "stages.length={kind: train.length, steps: 4, batch: {global: 8, slices: 2}}";
    let named = "stages.release.sampler={steps: 1, guidance: 3}";
    let sets = ["--set", length, "--set", "stages.release.length=length", "--set", named];
    bench.run(&[&["run", &config], &other[..], &sets[..]].concat()).expect_code(0);
    let own = generate(&["--model", "smoke@staging"]);
    assert_eq!(own["sampler"]["guidance"], 3.0, "{own}");
    let frames = own["frames"].as_u64().expect("a length");
    assert!(frames > 0 && frames % 4 == 0, "{own}");
    assert_eq!(generate(&["--model", "smoke@staging", "--frames", "60"])["frames"], 60);
    let shown = bench.run(&["registry", "show", "smoke@staging"]).expect_code(0).stdout;
    assert!(shown.contains("length="), "{shown}");

    // A whole model is exported part by part.
    bench.run(&["registry", "export", "smoke@staging", "out"]).expect_code(0);
    for file in [
        "manifest.json",
        "denoiser/manifest.json",
        "vae/model.safetensors",
        "text/manifest.json",
        "length/manifest.json",
    ] {
        assert!(bench.path().join("out").join(file).is_file(), "{file}");
    }
}
