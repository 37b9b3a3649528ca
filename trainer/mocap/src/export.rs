//! Writes motions to files, in the form of the file's extension, and reads motions from arrays.
//!
//! `.html` and `.png` hold several motions, all others one; [`gif_of_all`] draws several beside each other. `.bvh`
//! (centimetres) and `.glb` (metres) have constant bone lengths. If a figure's bones change, its joints are placed by
//! directions and mean lengths; [`Written`] reports the error. `.npy` has features if there are some, else positions.
//! `.mp4` needs an `ffmpeg` on the machine.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write as _};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use motion::features::recover_joints;
use motion::npy::{self, NpyError};
use motion::waypoints::Waypoint;
use motion::{DataPath, Skeleton, draw};
use protocol::stage::DataFormat;

use crate::body::Body;
use crate::bvh::{Bvh, BvhError};
use crate::glb::{self, GlbError};
use crate::html::{MOST_PANELS, Page, PageError, Panel, Section};
use crate::joint_map::MapError;
use crate::plant::plant;
use crate::rig::{Rig, RigError};
use crate::take::{self, Reading, Take};

/// Number of poses of one motion on a sheet.
const POSES: usize = 10;

/// Largest number of motions on a sheet of poses, whose picture is in memory: 70 MB.
const MOST_ROWS: usize = 100;

/// Program that encodes videos.
const ENCODER: &str = "ffmpeg";

/// Form of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// A skeleton and its rotations, for animation programs.
    Bvh,
    /// An animated figure, for animation programs and viewers of 3D scenes.
    Glb,
    /// A moving picture.
    Gif,
    /// A sheet of poses.
    Png,
    /// A page that shows motions from all sides.
    Html,
    /// An array of features or positions.
    Npy,
    /// A video, encoded by ffmpeg.
    Mp4,
}

impl Form {
    /// All forms with their extensions.
    pub const ALL: [(&'static str, Form); 7] = [
        ("bvh", Form::Bvh),
        ("glb", Form::Glb),
        ("gif", Form::Gif),
        ("png", Form::Png),
        ("html", Form::Html),
        ("npy", Form::Npy),
        ("mp4", Form::Mp4),
    ];

    /// The form of a file, from the extension of its name.
    ///
    /// # Errors
    /// Another extension; the message lists the known ones.
    pub fn of(path: &Path) -> Result<Self, ExportError> {
        let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_lowercase();
        let found = Self::ALL.iter().find(|(word, _)| *word == ending);
        found.map(|(_, form)| *form).ok_or_else(|| ExportError::Ending(path.into()))
    }

    /// Returns true if a file can hold several motions.
    pub fn holds_several(self) -> bool {
        matches!(self, Self::Png | Self::Html)
    }
}

/// A motion that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The extension of the name is unknown.
    #[error(
        "cannot write `{}`: expected a file name that ends in .bvh, .glb, .gif, .png, .html, .npy or .mp4",
        .0.display()
    )]
    Ending(PathBuf),
    /// A form of one motion with several or none, or a sheet with too many.
    #[error("cannot write `{}`: there are {count} motions; expected {expected}", file.display())]
    Count {
        file: PathBuf,
        /// Number of motions given.
        count: usize,
        /// Numbers that the form accepts.
        expected: &'static str,
    },
    /// An error of the file system or of the drawing.
    #[error("cannot write `{}`: {source}", file.display())]
    Io { file: PathBuf, source: io::Error },
    /// The joints have no rotations.
    #[error("cannot write `{}`: {source}", file.display())]
    Rig { file: PathBuf, source: RigError },
    /// The motion has no animation.
    #[error("cannot write `{}`: {source}", file.display())]
    Glb { file: PathBuf, source: GlbError },
    /// The motions cannot be put on a page.
    #[error("cannot write `{}`: {source}", file.display())]
    Page { file: PathBuf, source: PageError },
    /// No video encoder was found.
    #[error("cannot write `{}`: the program `{program}` is not installed; install it, or write a .gif", file.display())]
    NoEncoder {
        file: PathBuf,
        /// Name of the program.
        program: String,
    },
    /// The video encoder failed.
    #[error("cannot write `{}`: ffmpeg failed: {said}", file.display())]
    Encoder {
        file: PathBuf,
        /// End of its error output.
        said: String,
    },
    /// The array is not a motion.
    #[error(transparent)]
    Npy(#[from] NpyError),
    /// The recording cannot be parsed.
    #[error(transparent)]
    Bvh(#[from] BvhError),
    /// The joints of the recording were not found.
    #[error("{}: {source}", file.display())]
    Map { file: PathBuf, source: MapError },
    /// An array of another shape, values that are not finite, or an unknown extension.
    #[error("{}: {what}", file.display())]
    Array {
        file: PathBuf,
        /// The content found, and the content expected.
        what: String,
    },
}

/// A motion to write.
#[derive(Debug, Clone)]
pub struct Motion {
    /// Description of the motion, such as its prompt.
    pub caption: String,
    /// Origin of the motion, such as model and seed.
    pub note: String,
    /// Skeleton of the joints.
    pub skeleton: &'static Skeleton,
    /// Positions `[T, J, 3]` in the skeleton's unit.
    pub joints: Vec<f32>,
    /// Features `[L, D]` in the data's scale, if the motion has them.
    pub features: Option<Vec<f32>>,
    /// Waypoints of the motion.
    pub waypoints: Vec<Waypoint>,
    /// Frames that were kept when a part of the motion was regenerated.
    pub kept: Vec<Range<usize>>,
}

/// A file that was written.
#[derive(Debug, Clone, PartialEq)]
pub struct Written {
    /// Path of the file.
    pub path: PathBuf,
    /// Largest distance of a joint from the motion's, in metres; `None` for a form that stores positions.
    pub off_metres: Option<f64>,
}

impl Motion {
    /// Reads a file: an array like [`Motion::read_npy`], or a recording in BVH, mapped to the 22 joints of HumanML3D
    /// and sampled at its 20 frames per second. `reading` holds the user's settings for recordings; the note describes
    /// the interpretation.
    ///
    /// # Errors
    /// If the file is neither, or broken.
    pub fn read(file: &Path, reading: &Reading) -> Result<Self, ExportError> {
        match Form::of(file) {
            Ok(Form::Npy) => Self::read_npy(file),
            Ok(Form::Bvh) => {
                let bvh = Bvh::read(&DataPath::local(file))?;
                let take = Take::of_bvh(&bvh, reading);
                let take = take.map_err(|source| ExportError::Map { file: file.into(), source })?;
                let skeleton = Skeleton::of(DataFormat::Humanml3d);
                let joints = take::resample(&take.joints, 3 * skeleton.joints, take.rate, skeleton.fps);
                let joints = joints.into_iter().map(|v| v as f32).collect();
                Ok(Self { note: take.said, ..Self::of(file, skeleton, joints, None) })
            }
            _ => {
                let what = "expected an array (.npy) or a recording (.bvh)".to_owned();
                Err(ExportError::Array { file: file.into(), what })
            }
        }
    }

    /// Makes a motion named after its file.
    fn of(file: &Path, skeleton: &'static Skeleton, joints: Vec<f32>, features: Option<Vec<f32>>) -> Self {
        let caption = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Self { caption, note: String::new(), skeleton, joints, features, waypoints: Vec::new(), kept: Vec::new() }
    }

    /// Reads an array: features `[L, 263]` or `[L, 251]`, or positions `[T, 22, 3]` or `[T, 21, 3]`.
    ///
    /// # Errors
    /// If the file is no array, has another shape, or has values that are not finite.
    pub fn read_npy(file: &Path) -> Result<Self, ExportError> {
        let array = npy::read_any_float(&DataPath::local(file))?;
        let refuse = |what: String| ExportError::Array { file: file.into(), what };
        let known = [DataFormat::Humanml3d, DataFormat::Kit].map(Skeleton::of);
        let fits = |skeleton: &&&Skeleton| match array.shape[..] {
            [_, width] => width == skeleton.features,
            [_, joints, 3] => joints == skeleton.joints,
            _ => false,
        };
        let Some(skeleton) = known.iter().find(fits).copied().filter(|_| array.shape[0] > 0) else {
            return Err(refuse(format!(
                "has shape {:?}; expected features [frames, 263] or [frames, 251], or positions [frames, 22, 3] or [frames, 21, 3]",
                array.shape
            )));
        };
        let width = array.data.len() / array.shape[0];
        if let Some(at) = array.data.iter().position(|value| !value.is_finite()) {
            return Err(refuse(format!("frame {} has a number that is not finite", at / width)));
        }
        let (joints, features) = match array.shape.len() {
            2 => (recover_joints(&array.data, skeleton), Some(array.data)),
            _ => (array.data, None),
        };
        Ok(Self::of(file, skeleton, joints, features))
    }

    /// Fixes standing feet in place; see [`plant`](crate::plant). The result has only positions.
    #[must_use]
    pub fn planted(self) -> Self {
        Self { joints: plant(&self.joints, self.skeleton), features: None, ..self }
    }

    /// Number of frames T.
    pub fn frames(&self) -> usize {
        self.joints.len() / (3 * self.skeleton.joints)
    }

    /// Writes the motion alone to a file.
    ///
    /// # Errors
    /// If the form cannot hold the motion, or the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<Written, ExportError> {
        let form = Form::of(path)?;
        let io = |source| ExportError::Io { file: path.into(), source };
        let mut off_metres = None;
        let mut rig = || {
            let rig = Rig::fit(&self.joints, self.skeleton);
            let rig = rig.map_err(|source| ExportError::Rig { file: path.into(), source })?;
            off_metres = Some(rig.error * self.skeleton.metres_per_unit);
            Ok::<_, ExportError>(rig)
        };
        let Skeleton { fps, metres_per_unit, .. } = *self.skeleton;
        match form {
            Form::Bvh => fs::write(path, rig()?.to_bvh(fps, 100.0 * metres_per_unit).to_text()).map_err(io)?,
            Form::Glb => {
                let bytes = glb::to_bytes(&rig()?, fps, metres_per_unit, &self.caption);
                fs::write(path, bytes.map_err(|source| ExportError::Glb { file: path.into(), source })?).map_err(io)?;
            }
            Form::Gif => {
                draw::gif_along(&self.joints, self.skeleton, &self.caption, &self.waypoints, path).map_err(io)?;
            }
            Form::Npy => match &self.features {
                Some(features) => {
                    let width = self.skeleton.features;
                    npy::write(path, &[features.len() / width, width], features)?;
                }
                None => npy::write(path, &[self.frames(), self.skeleton.joints, 3], &self.joints)?,
            },
            Form::Mp4 => self.mp4(path, ENCODER)?,
            Form::Png | Form::Html => {
                let sections = [(String::new(), vec![self])];
                write_all(&self.caption, &sections, path)?;
            }
        }
        Ok(Written { path: path.into(), off_metres })
    }

    /// Encodes a video with `program`, which has the arguments of ffmpeg.
    fn mp4(&self, path: &Path, program: &str) -> Result<(), ExportError> {
        let io = |source| ExportError::Io { file: path.into(), source };
        let [width, height] = draw::FILM;
        // A name that starts with a dash, or resembles a protocol, is still a file.
        let mut name = std::ffi::OsString::from("file:");
        name.push(path);
        let mut encoder = Command::new(program);
        encoder.args([
            "-hide_banner",
            "-loglevel",
            "error",
            "-nostdin",
            "-y",
            "-f",
            "rawvideo",
            "-pixel_format",
            "rgb24",
        ]);
        encoder.args(["-video_size", &format!("{width}x{height}"), "-framerate", &self.skeleton.fps.to_string()]);
        encoder.args(["-i", "pipe:0", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]).arg(name);
        encoder.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        let mut encoder = encoder.spawn().map_err(|error| match error.kind() {
            io::ErrorKind::NotFound => ExportError::NoEncoder { file: path.into(), program: program.to_owned() },
            _ => io(error),
        })?;
        let stdin = encoder.stdin.take().ok_or_else(|| io(io::Error::other("the encoder has no input")))?;
        let (drawn, output) = std::thread::scope(|scope| {
            // Parallel to reading its output, so that neither waits for the other.
            let draws = scope.spawn(|| {
                draw::rgb_along_to(&self.joints, self.skeleton, &self.caption, &self.waypoints, BufWriter::new(stdin))
            });
            let output = encoder.wait_with_output();
            (draws.join().unwrap_or_else(|_| Err(io::Error::other("the drawing failed"))), output)
        });
        let output = output.map_err(io)?;
        if !output.status.success() {
            let said = String::from_utf8_lossy(&output.stderr);
            let said = said.lines().next_back().unwrap_or("no message").to_owned();
            return Err(ExportError::Encoder { file: path.into(), said });
        }
        drawn.map_err(io)
    }
}

/// Writes motions on one page or sheet, in sections with a title each.
///
/// # Errors
/// If the form holds one motion, there are too many, or the file cannot be written.
pub fn write_all(title: &str, sections: &[(String, Vec<&Motion>)], path: &Path) -> Result<Written, ExportError> {
    let form = Form::of(path)?;
    let motions = || sections.iter().flat_map(|(_, motions)| motions.iter().copied());
    let count = motions().count();
    let io = |source| ExportError::Io { file: path.into(), source };
    let refuse = |expected| Err(ExportError::Count { file: path.into(), count, expected });
    match form {
        Form::Html => {
            let mut bodies: Vec<(&Skeleton, Body)> = Vec::new();
            for motion in motions() {
                if bodies.iter().all(|(skeleton, _)| *skeleton != motion.skeleton) {
                    bodies.push((motion.skeleton, Body::of(motion.skeleton)));
                }
            }
            let mut page = Page { title: title.to_owned(), sections: Vec::new() };
            for (title, motions) in sections {
                let panels = motions.iter().filter_map(|motion| panel(motion, &bodies)).collect();
                page.sections.push(Section { title: title.clone(), panels });
            }
            let failed = |source| ExportError::Page { file: path.into(), source };
            page.write(BufWriter::new(File::create(path).map_err(io)?)).map_err(failed)?;
        }
        Form::Png => {
            let Some(first) = motions().next() else { return refuse("at least one") };
            if count > MOST_ROWS {
                return refuse("at most 100 on a sheet");
            }
            if motions().any(|motion| motion.skeleton != first.skeleton) {
                return refuse("motions of one skeleton");
            }
            let row = |title: &str, m: &Motion| draw::Row {
                title: if m.caption.contains(title) { m.caption.clone() } else { format!("{title}: {}", m.caption) },
                note: m.note.clone(),
                joints: m.joints.clone(),
            };
            let rows: Vec<draw::Row> =
                sections.iter().flat_map(|(title, motions)| motions.iter().map(|m| row(title, m))).collect();
            let given = draw::Given { waypoints: &first.waypoints, kept: &first.kept };
            draw::sheet(&rows, POSES, first.skeleton, given, path).map_err(io)?;
        }
        Form::Bvh | Form::Glb | Form::Gif | Form::Npy | Form::Mp4 => {
            let Some(first) = motions().next().filter(|_| count == 1) else { return refuse("one") };
            return first.write(path);
        }
    }
    Ok(Written { path: path.into(), off_metres: None })
}

/// Writes all motions beside each other in one animated GIF, with their captions and notes.
///
/// # Errors
/// If there is no motion, or the file cannot be written.
pub fn gif_of_all(motions: &[Motion], path: &Path) -> Result<(), ExportError> {
    let io = |source| ExportError::Io { file: path.into(), source };
    let Some(first) = motions.first() else {
        return Err(ExportError::Count { file: path.into(), count: 0, expected: "at least one" });
    };
    let row = |motion: &Motion| draw::Row {
        title: motion.caption.clone(),
        note: motion.note.clone(),
        joints: motion.joints.clone(),
    };
    let rows: Vec<draw::Row> = motions.iter().map(row).collect();
    let mut file = BufWriter::new(File::create(path).map_err(io)?);
    draw::gif_of_all_to(&rows, first.skeleton, &mut file).and_then(|()| file.flush()).map_err(io)
}

/// Output files for a known number of motions: one per motion, or one for all, depending on their forms.
#[derive(Debug, Clone)]
pub struct Outs {
    alone: Vec<PathBuf>,
    together: Vec<PathBuf>,
    count: usize,
}

impl Outs {
    /// Checks the names before anything is drawn, and the encoder if a video is requested.
    ///
    /// # Errors
    /// An unknown extension, more motions than a form holds, or a missing video encoder.
    pub fn new(paths: &[PathBuf], count: usize) -> Result<Self, ExportError> {
        let mut outs = Self { alone: Vec::new(), together: Vec::new(), count };
        for path in paths {
            let form = Form::of(path)?;
            let most = match form {
                Form::Png => (MOST_ROWS, "at most 100 on a sheet"),
                Form::Html => (MOST_PANELS, "at most 512 on a page"),
                _ => (usize::MAX, ""),
            };
            if count > most.0 {
                return Err(ExportError::Count { file: path.clone(), count, expected: most.1 });
            }
            if form == Form::Mp4 && !is_here(ENCODER) {
                return Err(ExportError::NoEncoder { file: path.clone(), program: ENCODER.to_owned() });
            }
            if form.holds_several() { &mut outs.together } else { &mut outs.alone }.push(path.clone());
        }
        Ok(outs)
    }

    /// Returns true if there are no output files.
    pub fn is_empty(&self) -> bool {
        self.alone.is_empty() && self.together.is_empty()
    }

    /// Returns true if a file needs all motions together at the end.
    pub fn wants_all(&self) -> bool {
        !self.together.is_empty()
    }

    /// Writes the files of one motion; `number` counts from 1.
    ///
    /// # Errors
    /// As [`Motion::write`].
    pub fn write(&self, number: usize, motion: &Motion) -> Result<Vec<Written>, ExportError> {
        self.alone.iter().map(|path| motion.write(&numbered(path, number, self.count))).collect()
    }

    /// Writes the files that hold all motions.
    ///
    /// # Errors
    /// As [`write_all`].
    pub fn finish(&self, title: &str, sections: &[(String, Vec<&Motion>)]) -> Result<Vec<Written>, ExportError> {
        self.together.iter().map(|path| write_all(title, sections, path)).collect()
    }
}

/// Returns true if a program can be started.
fn is_here(program: &str) -> bool {
    let mut command = Command::new(program);
    command.arg("-version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    command.status().is_ok()
}

/// A motion as a panel of the page, with its body from the page's list.
fn panel<'a>(motion: &'a Motion, bodies: &'a [(&Skeleton, Body)]) -> Option<Panel<'a>> {
    let (_, body) = bodies.iter().find(|(skeleton, _)| *skeleton == motion.skeleton)?;
    let Motion { caption, note, joints, waypoints, .. } = motion;
    Some(Panel { caption: caption.clone(), note: note.clone(), body, joints, waypoints })
}

/// The file name of one of several motions: `walk.bvh` becomes `walk-03.bvh`.
pub fn numbered(path: &Path, number: usize, count: usize) -> PathBuf {
    if count < 2 {
        return path.into();
    }
    let digits = count.to_string().len().max(2);
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default().to_string_lossy();
    path.with_file_name(format!("{stem}-{number:0digits$}.{ending}"))
}

#[cfg(test)]
mod tests {
    use motion::synthetic;
    use protocol::Seed;
    use protocol::stage::DataSynthetic;

    use super::*;

    fn motion() -> Motion {
        let dataset = synthetic::generate(&DataSynthetic { clips: 1, ..DataSynthetic::default() }, Seed(1));
        let features = dataset.clips[0].features.to_vec();
        Motion {
            caption: "a person walks forward.".into(),
            note: "seed 1".into(),
            skeleton: dataset.skeleton(),
            joints: recover_joints(&features, dataset.skeleton()),
            features: Some(features),
            waypoints: Vec::new(),
            kept: Vec::new(),
        }
    }

    #[test]
    fn each_form_is_written_and_arrays_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let motion = motion();
        for (ending, begins) in [
            ("bvh", &b"HIERARCHY"[..]),
            ("glb", b"glTF"),
            ("gif", b"GIF89a"),
            ("PNG", b"\x89PNG"),
            ("html", b"<!DOCTYPE html>"),
            ("npy", b"\x93NUMPY"),
        ] {
            let file = folder.path().join(format!("walk.{ending}"));
            let written = motion.write(&file).unwrap();
            assert!(fs::read(&file).unwrap().starts_with(begins), "{ending}");
            assert_eq!(written.off_metres.is_some(), ["bvh", "glb"].contains(&ending), "{ending}");
            assert!(written.off_metres.is_none_or(|off| off < 1e-3), "{ending}: {:?} m", written.off_metres);
        }
        let back = Motion::read_npy(&folder.path().join("walk.npy")).unwrap();
        assert_eq!((&back.joints, &back.features, back.caption.as_str()), (&motion.joints, &motion.features, "walk"));
        let bvh = Motion::read(&folder.path().join("walk.bvh"), &Reading::default()).unwrap();
        assert!(bvh.note.contains("centimetre") && bvh.frames() == motion.frames(), "{}", bvh.note);
        let worst = bvh.joints.iter().zip(&motion.joints).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        println!("a .bvh of ours comes back to {worst:.1e} m");
        assert!(worst < 1e-3, "{worst}");
        assert!(Motion::read(&folder.path().join("walk.gif"), &Reading::default()).is_err());
        let file = folder.path().join("joints.npy");
        Motion { features: None, ..motion.clone() }.write(&file).unwrap();
        let back = Motion::read_npy(&file).unwrap();
        assert_eq!((back.joints, back.features), (motion.joints, None));
    }

    #[test]
    fn several_go_on_one_page_or_get_numbers() {
        let folder = tempfile::tempdir().unwrap();
        let motion = motion();
        let at = |name: &str| folder.path().join(name);
        let sections = [("one".to_owned(), vec![&motion, &motion]), ("two".to_owned(), vec![&motion])];
        write_all("three", &sections, &at("all.html")).unwrap();
        assert_eq!(fs::read_to_string(at("all.html")).unwrap().matches("<figure>").count(), 3);
        write_all("three", &sections, &at("all.png")).unwrap();
        let refused = write_all("three", &sections, &at("all.bvh")).unwrap_err().to_string();
        assert!(refused.contains("3 motions; expected one"), "{refused}");
        let many = [(String::new(), vec![&motion; 101])];
        assert!(write_all("x", &many, &at("x.png")).unwrap_err().to_string().contains("at most 100"));
        let outs = Outs::new(&[at("n.npy"), at("n.html"), at("n.glb")], 2).unwrap();
        let written = outs.write(2, &motion).unwrap();
        let names: Vec<&Path> = written.iter().map(|written| written.path.as_path()).collect();
        assert_eq!(names, [at("n-02.npy"), at("n-02.glb")]);
        assert!(outs.wants_all() && outs.finish("two", &sections[..1]).unwrap()[0].path == at("n.html"));
        assert!(Outs::new(&[at("n.html")], 513).unwrap_err().to_string().contains("at most 512"));
        assert!(Outs::new(&[at("n.fbx")], 1).is_err() && !is_here("no-such-program"));
        assert_eq!(numbered(Path::new("a/walk.bvh"), 3, 12), Path::new("a/walk-03.bvh"));
        assert_eq!(numbered(Path::new("walk.tar.bvh"), 3, 100), Path::new("walk.tar-003.bvh"));
        assert_eq!(numbered(Path::new("walk.bvh"), 1, 1), Path::new("walk.bvh"));
    }

    #[test]
    fn a_video_is_made_where_there_is_an_encoder() {
        let folder = tempfile::tempdir().unwrap();
        let mut motion = motion();
        motion.joints.truncate(20 * 66);
        let file = folder.path().join("-walk.mp4");
        let refused = motion.mp4(&file, "no-such-encoder").unwrap_err().to_string();
        assert!(refused.contains("`no-such-encoder`") && refused.contains(".gif"), "{refused}");
        let refused = motion.mp4(&file, "false").unwrap_err().to_string();
        assert!(refused.contains("no message"), "{refused}");
        match motion.write(&file) {
            Ok(_) => assert_eq!(&fs::read(&file).unwrap()[4..8], b"ftyp"),
            Err(ExportError::NoEncoder { .. }) => fixtures::skip("there is no ffmpeg here to make a video with"),
            Err(error) => panic!("{error}"),
        }
    }

    #[test]
    fn what_is_no_motion_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.npy");
        for (shape, values) in [(&[4, 100][..], 400), (&[2, 3, 22], 132), (&[0, 263], 0), (&[263], 263)] {
            npy::write(&file, shape, &vec![0.0; values]).unwrap();
            let refused = Motion::read_npy(&file).unwrap_err().to_string();
            assert!(refused.contains("a.npy") && refused.contains("[frames, 263]"), "{refused}");
        }
        npy::write(&file, &[2, 22, 3], &[f32::NAN; 132]).unwrap();
        assert!(Motion::read_npy(&file).unwrap_err().to_string().contains("frame 0"));
        for name in ["walk", "walk.fbx", "walk.npy.zip"] {
            let refused = motion().write(Path::new(name)).unwrap_err().to_string();
            assert!(refused.contains(".bvh, .glb"), "{refused}");
        }
        let refused = motion().write(&folder.path().join("none/walk.glb")).unwrap_err().to_string();
        assert!(refused.contains("none/walk.glb"), "{refused}");
    }
}
