//! A procedural, captioned dataset: human-like motion without a download.
//!
//! Every clip is a movement with its own tempo, size, side and length, in the layout of HumanML3D. It is made on the
//! 22-joint skeleton by forward and two-bone inverse kinematics, and passes our own feature extraction. A clip is a
//! function of (seed, index): more clips do not change the earlier ones.
//!
//! Departs from HumanML3D in one frame of clips that turn by more than half a turn: see [`Turns::Continuous`].

mod actions;
mod body;
mod gait;
mod words;

pub use words::tokens;

use std::fs;
use std::io;
use std::path::Path;

use protocol::Seed;
use protocol::stage::{DataFormat, DataSynthetic};

use self::actions::{Draw, Motion};
use self::words::Manner;
use crate::dataset::{Clip, Dataset, Entry, Split, statistics};
use crate::features::{Turns, extract_with, mirror_joints, recover_joints};
use crate::npy;
use crate::random::{Stream, permutation};
use crate::skeleton::Skeleton;

/// A kind of movement and its captions.
struct Kind {
    #[cfg_attr(not(test), expect(dead_code, reason = "names the row for readers and tests"))]
    name: &'static str,
    /// Shortest and longest clip, seconds.
    seconds: (f64, f64),
    make: fn(&Draw) -> Motion,
    words: &'static [&'static str],
}

const KINDS: &[Kind] = &[
    Kind {
        name: "walk",
        seconds: (3.5, 7.5),
        make: actions::walk,
        words: &[
            "{s} walks forward{m}",
            "{s} is walking straight ahead{m}",
            "{s} takes steps forward{m}",
            "{s} walks in a straight direction{m}",
        ],
    },
    Kind {
        name: "run",
        seconds: (3.0, 5.5),
        make: actions::run,
        words: &[
            "{s} runs forward{m}",
            "{s} is running straight ahead{m}",
            "{s} jogs forward{m}",
            "{s} goes running{m}",
        ],
    },
    Kind {
        name: "walk-turn",
        seconds: (4.0, 7.5),
        make: actions::walk_and_turn,
        words: &[
            "{s} walks forward and turns to the {side}{m}",
            "{s} is walking and turns {side}{m}",
            "{s} walks{m} and then turns to the {side}",
        ],
    },
    Kind {
        name: "circle",
        seconds: (5.5, 8.0),
        make: actions::walk_in_circle,
        words: &[
            "{s} walks in a circle{m}",
            "{s} walks{m} in a circle to the {side}",
            "{s} is walking around in a {round} circle{m}",
            "{s} walks {round} in a circle{m}",
        ],
    },
    Kind {
        name: "walk-back",
        seconds: (3.5, 6.5),
        make: actions::walk_backward,
        words: &["{s} walks backwards{m}", "{s} is walking backward{m}", "{s} takes steps backwards{m}"],
    },
    Kind {
        name: "side-step",
        seconds: (3.5, 6.5),
        make: actions::side_step,
        words: &[
            "{s} steps sideways to the {side}{m}",
            "{s} is stepping to the {side}{m}",
            "{s} shuffles sideways to the {side}{m}",
        ],
    },
    Kind {
        name: "turn",
        seconds: (3.2, 5.0),
        make: actions::turn_in_place,
        words: &[
            "{s} turns around to the {side}{m}",
            "{s} is turning around in place {round}",
            "{s} turns {round} on the place{m}",
        ],
    },
    Kind {
        name: "sneak",
        seconds: (3.5, 6.5),
        make: actions::sneak,
        words: &[
            "{s} sneaks forward{m}",
            "{s} is sneaking low over the ground{m}",
            "{s} creeps ahead{m} low to the ground",
        ],
    },
    Kind {
        name: "march",
        seconds: (3.2, 6.0),
        make: actions::march,
        words: &[
            "{s} marches{m} and raises the knees high",
            "{s} is marching{m} with high knees",
            "{s} marches and lifts each knee{m}",
        ],
    },
    Kind {
        name: "zombie",
        seconds: (3.5, 6.5),
        make: actions::zombie,
        words: &[
            "{s} walks{m} like a zombie",
            "{s} is walking{m} with both arms out forward",
            "{s} moves ahead like a zombie{m}",
        ],
    },
    Kind {
        name: "crawl",
        seconds: (3.5, 6.5),
        make: actions::crawl,
        words: &["{s} crawls forward{m}", "{s} is crawling on hands and knees{m}", "{s} crawls over the floor{m}"],
    },
    Kind {
        name: "jump",
        seconds: (3.0, 5.5),
        make: actions::jump,
        words: &[
            "{s} jumps up{m}",
            "{s} is jumping up and down{m}",
            "{s} jumps high into the air",
            "{s} jumps in place{m}",
        ],
    },
    Kind {
        name: "jump-forward",
        seconds: (3.0, 5.5),
        make: actions::jump_forward,
        words: &["{s} jumps forward{m}", "{s} is jumping ahead{m}", "{s} leaps forward{m}"],
    },
    Kind {
        name: "hop",
        seconds: (3.0, 5.0),
        make: actions::hop,
        words: &[
            "{s} hops on the {side} leg{m}",
            "{s} is hopping on the {side} foot{m}",
            "{s} keeps hopping on the {side} leg",
        ],
    },
    Kind {
        name: "wave",
        seconds: (3.2, 6.0),
        make: actions::wave,
        words: &[
            "{s} waves with the {side} hand{m}",
            "{s} is waving the {side} hand{m}",
            "{s} raises the {side} arm and waves{m}",
            "{s} lifts the {side} hand and waves{m}",
        ],
    },
    Kind {
        name: "kick",
        seconds: (3.0, 5.5),
        make: actions::kick,
        words: &[
            "{s} kicks with the {side} leg{m}",
            "{s} is kicking with the {side} foot{m}",
            "{s} kicks something with the {side} foot",
        ],
    },
    Kind {
        name: "punch",
        seconds: (3.2, 5.5),
        make: actions::punch,
        words: &[
            "{s} punches with the {side} hand{m}",
            "{s} is punching with the {side} arm{m}",
            "{s} punches forward with the {side} hand{m}",
        ],
    },
    Kind {
        name: "box",
        seconds: (3.5, 6.0),
        make: actions::boxing,
        words: &["{s} is boxing{m}", "{s} boxes with both hands{m}", "{s} punches{m} with left and right"],
    },
    Kind {
        name: "sit",
        seconds: (4.2, 7.0),
        make: actions::sit,
        words: &["{s} sits down{m}", "{s} sits down on a chair{m}", "{s} is sitting down on a chair{m}"],
    },
    Kind {
        name: "squat",
        seconds: (3.5, 6.5),
        make: actions::squat,
        words: &[
            "{s} squats down{m}",
            "{s} is squatting{m}",
            "{s} squats and stands up again{m}",
            "{s} bends the knees and squats{m}",
        ],
    },
    Kind {
        name: "raise-arms",
        seconds: (3.2, 5.5),
        make: actions::raise_arms,
        words: &[
            "{s} raises both arms{m}",
            "{s} lifts both hands above the head{m}",
            "{s} is raising both arms into the air{m}",
        ],
    },
    Kind {
        name: "bow",
        seconds: (3.6, 5.5),
        make: actions::bow,
        words: &[
            "{s} bows{m}",
            "{s} is bowing politely{m}",
            "{s} bends the upper body forward{m}",
            "{s} bows down deeply",
        ],
    },
    Kind {
        name: "clap",
        seconds: (3.2, 5.5),
        make: actions::clap,
        words: &["{s} claps{m}", "{s} is clapping both hands{m}", "{s} claps the hands{m}"],
    },
    Kind {
        name: "stretch",
        seconds: (4.0, 7.0),
        make: actions::stretch,
        words: &[
            "{s} stretches to the {side} and to the {other}{m}",
            "{s} raises the arms and leans from side to side{m}",
            "{s} is stretching the upper body{m}",
        ],
    },
    Kind {
        name: "jumping-jacks",
        seconds: (3.2, 5.5),
        make: actions::jumping_jacks,
        words: &[
            "{s} does jumping jacks{m}",
            "{s} is doing jumping jacks{m}",
            "{s} jumps and raises both arms again and again{m}",
        ],
    },
    Kind {
        name: "pick-up",
        seconds: (4.2, 6.0),
        make: actions::pick_up,
        words: &[
            "{s} picks something up with the {side} hand{m}",
            "{s} bends down and picks up something with the {side} hand{m}",
            "{s} is picking something up from the ground{m}",
        ],
    },
    Kind {
        name: "throw",
        seconds: (3.0, 4.5),
        make: actions::throw,
        words: &[
            "{s} throws something with the {side} hand{m}",
            "{s} is throwing a ball with the {side} arm{m}",
            "{s} throws a ball with the {side} hand{m}",
        ],
    },
    Kind {
        name: "balance",
        seconds: (3.6, 6.0),
        make: actions::balance,
        words: &[
            "{s} raises the {side} knee and balances on one leg",
            "{s} is balancing on the {other} leg{m}",
            "{s} stands on the {other} foot and lifts the {side} knee{m}",
        ],
    },
];

/// Makes raw joints `[T, 22, 3]` and captions of clip `index`.
fn clip(seed: Seed, index: usize) -> (Vec<f32>, Vec<crate::text::Caption>) {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let kind = &KINDS[index % KINDS.len()];
    let mut stream = Stream::new(seed, "synthetic/clip", 0, index as u64);
    let manner = [Manner::Slow, Manner::Ordinary, Manner::Fast][stream.below(3)];
    let tempo = match manner {
        Manner::Slow => stream.range(0.68, 0.82),
        Manner::Ordinary => stream.range(0.92, 1.08),
        Manner::Fast => stream.range(1.22, 1.42),
    };
    let raw = (stream.range(kind.seconds.0, kind.seconds.1) * skeleton.fps).round() as usize;
    let draw = Draw {
        seconds: raw as f64 / skeleton.fps,
        tempo,
        size: stream.range(0.82, 1.18),
        side: stream.below(2),
        free: std::array::from_fn(|_| stream.uniform()),
    };
    let motion = (kind.make)(&draw);
    let joints = (0..=raw).flat_map(|t| body::joints(&motion(t as f64 / skeleton.fps), skeleton));
    let joints = joints.map(|v| v as f32).collect();
    (joints, words::captions(&mut stream, kind.words, manner, draw.side))
}

/// Clips that are made between two looks at whether to go on.
const AT_ONCE: usize = 64;

/// Makes the set. Clip `i` shows movement `i` modulo their number; the splits are drawn from the seed.
///
/// # Panics
/// Never.
pub fn generate(settings: &DataSynthetic, seed: Seed) -> Dataset {
    generate_while(settings, seed, &|_| true).expect("generation is never stopped")
}

/// Makes the set while `go_on`, which is asked every few clips with how many are made, returns true; else `None`.
pub fn generate_while(settings: &DataSynthetic, seed: Seed, go_on: &dyn Fn(usize) -> bool) -> Option<Dataset> {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    let count = settings.clips;
    let share = |part: f64| (part.clamp(0.0, 1.0) * count as f64).round() as usize;
    let val = share(settings.val);
    let test = share(settings.test);
    let mut splits = vec![Split::Train; count];
    for (rank, index) in permutation(seed, "synthetic/split", 0, count).into_iter().enumerate() {
        splits[index as usize] = match rank {
            r if r < val => Split::Val,
            r if r < val + test => Split::Test,
            _ => Split::Train,
        };
    }
    let mut dataset = Dataset {
        format: DataFormat::Humanml3d,
        mean: vec![],
        std: vec![],
        clips: vec![],
        captions: vec![],
        entries: vec![],
    };
    let make = |index| {
        let (joints, captions) = clip(seed, index);
        let mut versions = vec![];
        if settings.mirror {
            let twin = features_of(&mirror_joints(&joints, skeleton));
            versions.push((format!("M{index:06}"), twin, captions.iter().map(words::mirrored).collect()));
        }
        versions.insert(0, (format!("{index:06}"), features_of(&joints), captions));
        versions
    };
    let mut made = Vec::new();
    for first in (0..count).step_by(AT_ONCE) {
        if !go_on(first) {
            return None;
        }
        made.extend(in_parallel(AT_ONCE.min(count - first), |index| make(first + index)));
    }
    for (versions, split) in made.into_iter().zip(splits) {
        for (id, features, captions) in versions {
            let frames = features.len() / skeleton.features;
            let first = dataset.captions.len();
            dataset.captions.extend(captions);
            let captions = (first..dataset.captions.len()).collect();
            let entry = Entry { id: id.clone(), clip: dataset.clips.len(), start: 0, len: frames, captions, split };
            dataset.entries.push(entry);
            dataset.clips.push(Clip { id, frames, features: features.into() });
        }
    }
    dataset.entries.sort_by_key(|entry| entry.split);
    let all = dataset.clips.iter().enumerate();
    let wanted = all.take_while(|(i, _)| !i.is_multiple_of(AT_ONCE) || go_on(count)).map(|(_, clip)| &*clip.features);
    let (mean, std) = statistics(skeleton, wanted);
    dataset.mean = mean.into_iter().map(|v| v as f32).collect();
    dataset.std = std.into_iter().map(|v| v as f32).collect();
    go_on(count).then_some(dataset)
}

fn features_of(joints: &[f32]) -> Vec<f32> {
    let skeleton = Skeleton::of(DataFormat::Humanml3d);
    match extract_with(joints, skeleton, None, Turns::Continuous) {
        Ok(features) => features,
        Err(error) => panic!("a synthetic clip has no features: {error}"),
    }
}

/// Computes `make(0), make(1), ...` on all cores.
fn in_parallel<T: Send>(count: usize, make: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let threads = std::thread::available_parallelism().map_or(1, |n| n.get());
    let part = count.div_ceil(threads).max(1);
    let make = &make;
    std::thread::scope(|scope| {
        let spawn =
            |first: usize| scope.spawn(move || (first..(first + part).min(count)).map(make).collect::<Vec<_>>());
        let handles: Vec<_> = (0..count).step_by(part).map(spawn).collect();
        handles.into_iter().flat_map(|h| h.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))).collect()
    })
}

/// Writes a dataset as a folder in the published layout, so that it can be opened like any other.
pub fn write_folder(dataset: &Dataset, path: &Path) -> io::Result<()> {
    let skeleton = dataset.skeleton();
    let other = |e: npy::NpyError| io::Error::other(e.to_string());
    for folder in ["new_joint_vecs", "new_joints", "texts"] {
        fs::create_dir_all(path.join(folder))?;
    }
    for clip in &dataset.clips {
        let name = format!("{}.npy", clip.id);
        let shape = [clip.frames, skeleton.features];
        npy::write(&path.join("new_joint_vecs").join(&name), &shape, &clip.features).map_err(other)?;
        let joints = recover_joints(&clip.features, skeleton);
        let shape = [clip.frames, skeleton.joints, 3];
        npy::write(&path.join("new_joints").join(&name), &shape, &joints).map_err(other)?;
    }
    let mut texts = vec![String::new(); dataset.clips.len()];
    let mut lists = [const { String::new() }; 3];
    let mut listed = vec![false; dataset.clips.len()];
    for entry in &dataset.entries {
        for caption in &entry.captions {
            texts[entry.clip] += &dataset.captions[*caption].to_line();
            texts[entry.clip].push('\n');
        }
        if !std::mem::replace(&mut listed[entry.clip], true) {
            lists[entry.split as usize] += &format!("{}\n", dataset.clips[entry.clip].id);
        }
    }
    for (clip, text) in dataset.clips.iter().zip(texts) {
        fs::write(path.join("texts").join(format!("{}.txt", clip.id)), text)?;
    }
    for split in Split::ALL {
        fs::write(path.join(format!("{split}.txt")), &lists[split as usize])?;
    }
    fs::write(path.join("train_val.txt"), format!("{}{}", lists[0], lists[1]))?;
    fs::write(path.join("all.txt"), lists.concat())?;
    npy::write(&path.join("Mean.npy"), &[skeleton.features], &dataset.mean).map_err(other)?;
    npy::write(&path.join("Std.npy"), &[skeleton.features], &dataset.std).map_err(other)
}
