//! Stages that exist several times: `seeds: 3` makes `vae_1`, `vae_2` and `vae_3` of the stage `vae`, and `data.fold` one
//! stage for each fold.
//!
//! A stage's name keys its draws, so the copies differ in all random draws and in nothing else. Every stage that reads a
//! copied stage is copied with it, unless it names one copy, such as `vae_1`. A `register` stage is not copied: its `from`
//! takes all copies. The rules apply to the stages as they are written, so [`pin`] first replaces such a name by that of
//! the stage. [`expand`] makes the copies of a pipeline without mistakes.

use std::collections::{BTreeMap, BTreeSet};

use protocol::id::is_stage_name;
use protocol::stage::{DataFold, Register, Shape, StageSettings, Target};
use protocol::{StageName, limits};

use crate::definition::{IN_EVALUATION, PipelineStage};
use crate::graph;
use crate::rules::Problem;
use crate::trial;

/// Key of a stage that says how often it exists.
pub(crate) const KEY: &str = "seeds";

/// Meaning of the key.
pub(crate) const MEANING: &str = "Number of times that the stage exists, from different random draws: as `NAME_1`, \
    `NAME_2` and so on. Stages that read it exist as often; the `from` of a `register` stage takes all of them.";

/// Number of copies by stage.
pub(crate) type Counts = BTreeMap<StageName, usize>;

/// Numbers of the copies that references name, by stage and field.
pub(crate) type Pins = BTreeMap<(StageName, String), usize>;

/// A problem of a stage.
type Refused = (StageName, Problem);

/// Replaces references to one copy by references to the stage, and returns the numbers. `names` are all stages, `written`
/// has the numbers that stages are given. Without a copied stage it changes nothing.
pub(crate) fn pin(stages: &mut [PipelineStage], names: &BTreeSet<StageName>, written: &Counts) -> Pins {
    let mut pins = Pins::new();
    if written.is_empty() && stages.iter().all(|stage| every_fold(&stage.settings).is_none()) {
        return pins;
    }
    for stage in stages {
        each_reference(stage, |of, field, name| {
            let (base, best) = name.split_once('@').map_or((&**name, None), |(base, best)| (base, Some(best)));
            let Some((copied, number)) = base.rsplit_once('_') else { return };
            let Ok(number) = number.parse() else { return };
            if !names.contains(&StageName::new(base)) && names.contains(&StageName::new(copied)) {
                let copied = best.map_or_else(|| copied.to_owned(), |best| format!("{copied}@{best}"));
                *name = copied;
                pins.insert((of.clone(), field), number);
            }
        });
    }
    pins
}

/// Calls `visit` with the stage's name, a field that names one stage, and that name, for its settings and those of its
/// sweep's evaluation.
fn each_reference(stage: &mut PipelineStage, mut visit: impl FnMut(&StageName, String, &mut String)) {
    let mut all = |settings: &mut StageSettings, prefix: &str| {
        for reference in settings.refs() {
            if matches!(reference.target, Target::Stage(_)) && reference.read && !reference.field.contains('[') {
                visit(&stage.name, format!("{prefix}{}", reference.field), reference.name);
            }
        }
    };
    all(&mut stage.settings, "");
    if let Some(sweep) = &mut stage.sweep {
        all(&mut sweep.evaluate, IN_EVALUATION);
    }
}

/// Makes the copies. `written` has the numbers that stages are given; the stages are in topological order.
///
/// # Errors
/// The first stage that cannot exist so often, with the reason.
pub(crate) fn expand(stages: Vec<PipelineStage>, written: &Counts, pins: &Pins) -> Result<Vec<PipelineStage>, Refused> {
    let counts = counts(&stages, written, pins)?;
    let Some(most) = counts.values().max().copied() else { return Ok(stages) };
    check_names(&stages, &counts)?;
    let (copied, single): (Vec<_>, Vec<_>) = stages.into_iter().partition(|stage| counts.contains_key(&stage.name));
    let mut all = Vec::new();
    for mut stage in single {
        if let Some(register) = stage.settings.get::<Register>() {
            stage.settings = collected(register, &counts).map_err(|problem| (stage.name.clone(), problem))?.into();
        }
        refer(&mut stage, None, &counts, pins);
        all.push(stage);
    }
    // One training after the other, so that the first is whole before the others.
    for number in 1..=most {
        for stage in copied.iter().filter(|stage| number <= counts[&stage.name]) {
            let mut copy = (*stage).clone();
            if let Some(fold) = every_fold(&stage.settings) {
                copy.settings = DataFold { fold: number, ..fold.clone() }.into();
            }
            refer(&mut copy, Some(number), &counts, pins);
            copy.name = numbered(&stage.name, number);
            copy.copy_of = Some(stage.name.clone());
            all.push(copy);
        }
    }
    for stage in &mut all {
        stage.inputs = graph::references(&stage.settings);
        let swept = trial::references(stage);
        stage.inputs.extend(swept);
    }
    graph::add_evaluations(&mut all);
    let all = graph::sort(all).expect("copies of stages without a cycle have none");
    let mut found = BTreeMap::new();
    graph::check_totals(&all, &mut found);
    graph::check_agreement(&all, &mut found);
    match found.into_iter().find_map(|(name, problems)| Some((name, problems.0.into_iter().next()?))) {
        Some((name, problem)) => {
            let of = all.into_iter().find(|stage| stage.name == name).and_then(|stage| stage.copy_of);
            Err((of.unwrap_or(name), problem))
        }
        None => Ok(all),
    }
}

/// Number of copies of each stage that has more than one.
fn counts(stages: &[PipelineStage], written: &Counts, pins: &Pins) -> Result<Counts, Refused> {
    let mut counts = Counts::new();
    for stage in stages {
        let mut read: Option<(StageName, usize)> = None;
        for (field, name) in read_once(stage) {
            let count = counts.get(&name).copied();
            if let Some(number) = pins.get(&(stage.name.clone(), field.clone())) {
                let count = count.unwrap_or(1);
                if count == 1 || !(1..=count).contains(number) {
                    let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
                    let message = format!("`{field}` is `{name}_{number}`, but `{name}` exists {times}");
                    let help = format!("write `{name}`, or one of its copies, such as `{name}_1`");
                    return Err((stage.name.clone(), problem(&field, message, &help)));
                }
                continue;
            }
            let Some(count) = count else { continue };
            if stage.settings.shape() == Shape::Registry {
                let message =
                    format!("`{field}` is `{name}`, which exists {count} times; expected a stage that exists once");
                return Err((stage.name.clone(), problem(&field, message, "only `from` takes all copies of a stage")));
            }
            if let Some((other, others)) = &read
                && *others != count
            {
                let message = format!(
                    "it reads `{other}`, which exists {others} times, and `{name}`, which exists {count} times"
                );
                return Err((stage.name.clone(), problem(&field, message, "give both the same number of `seeds`")));
            }
            read = Some((name, count));
        }
        let own = every_fold(&stage.settings).map(|fold| fold.folds).or_else(|| written.get(&stage.name).copied());
        if own.is_some() && stage.settings.shape() == Shape::Registry {
            let message = format!("it has `{KEY}`, but a stage that registers exists once");
            return Err((stage.name.clone(), problem(KEY, message, "its `from` takes all copies of a stage")));
        }
        let count = match (own, &read) {
            (Some(own), Some((name, count))) if own != *count => {
                let message = format!("`{KEY}` is {own}, but `{name}`, which it reads, exists {count} times");
                let help = format!("remove `{KEY}`: the stage exists as often as what it reads");
                return Err((stage.name.clone(), problem(KEY, message, &help)));
            }
            (_, Some((_, count))) => *count,
            (own, None) => own.unwrap_or(1),
        };
        if count > 1 {
            counts.insert(stage.name.clone(), count);
        }
    }
    Ok(counts)
}

/// The settings of a stage that means all folds.
fn every_fold(settings: &StageSettings) -> Option<&DataFold> {
    settings.get::<DataFold>().filter(|fold| fold.fold == 0)
}

/// Fields of a stage that name one stage each, with that name: those of its settings and of its sweep's evaluation.
fn read_once(stage: &PipelineStage) -> Vec<(String, StageName)> {
    let inputs = graph::references(&stage.settings).into_iter().chain(trial::references(stage));
    inputs.filter(|input| !input.field.contains('[')).map(|input| (input.field, input.stage)).collect()
}

fn check_names(stages: &[PipelineStage], counts: &Counts) -> Result<(), Refused> {
    let names: BTreeSet<&StageName> = stages.iter().map(|stage| &stage.name).collect();
    let mut total = stages.len();
    for (name, count) in counts {
        total += count - 1;
        if total > limits::STAGES {
            let message = format!("with its copies, the pipeline has more than {} stages", limits::STAGES);
            return Err((
                name.clone(),
                problem("", message, "use fewer `seeds`, or distribute the stages over pipelines"),
            ));
        }
        for number in 1..=*count {
            let copy = numbered(name, number);
            if names.contains(&copy) {
                let message = format!("it exists {count} times, but another stage is called `{copy}`");
                return Err((name.clone(), problem("", message, "rename one of them")));
            }
            if !is_stage_name(copy.as_str()) {
                let message = format!("its copy would be called `{copy}`, which is too long");
                return Err((name.clone(), problem("", message, "choose a shorter name")));
            }
        }
    }
    Ok(())
}

/// The settings of a `register` stage that takes every copy of its candidates.
fn collected(register: &Register, counts: &Counts) -> Result<Register, Problem> {
    let required = register.promote.require.iter().enumerate();
    let metrics = required.map(|(i, gate)| (format!("promote.require[{i}]"), gate.as_str()));
    for (field, metric) in std::iter::once(("metric".to_owned(), register.metric.as_str())).chain(metrics) {
        let stage = metric.split_once('.').map(|(stage, _)| StageName::new(stage));
        if let Some((stage, count)) = stage.and_then(|stage| Some((counts.get(&stage)?, stage))).map(|(n, s)| (s, n)) {
            let message = format!("`{field}` names a value of `{stage}`, which exists {count} times");
            return Err(problem(&field, message, "write the value without the stage"));
        }
    }
    let every = |name: &String| -> Vec<String> {
        match counts.get(&StageName::new(&**name)) {
            Some(count) => (1..=*count).map(|number| format!("{name}_{number}")).collect(),
            None => vec![name.clone()],
        }
    };
    Ok(Register { from: register.from.iter().flat_map(every).collect(), ..register.clone() })
}

/// Makes the references of a stage name copies: the pinned ones, and otherwise the copies with its own number.
fn refer(stage: &mut PipelineStage, number: Option<usize>, counts: &Counts, pins: &Pins) {
    each_reference(stage, |of, field, name| {
        let pinned = pins.get(&(of.clone(), field)).copied();
        if let Some(number) = pinned.or(number)
            && counts.contains_key(&StageName::new(&**name))
        {
            *name = format!("{name}_{number}");
        }
    });
}

fn numbered(name: &StageName, number: usize) -> StageName {
    StageName::new(format!("{name}_{number}"))
}

fn problem(field: &str, message: String, help: &str) -> Problem {
    Problem { field: field.to_owned(), message, help: Some(help.to_owned()) }
}
