//! How much of anything the system takes, in one place: what is beyond is refused with a message that names the limit.
//!
//! A limit is chosen so that no honest use comes near it and no dishonest one can stop the others' work.

/// Stages of a submitted pipeline. Those that a sweep adds while its run goes on are bounded by
/// [`MAX_TRIALS`](crate::sweep::MAX_TRIALS) instead.
pub const STAGES: usize = 1_000;

/// Bytes of a call that says little: a poll, a checkpoint's or a task's end, a command.
pub const CALL_BYTES: usize = 1 << 20;
/// Bytes of a batch of values or of log lines.
pub const BATCH_BYTES: usize = 16 << 20;
/// Bytes of a submission, which carries its pipeline as it was written and as it was read.
pub const SUBMISSION_BYTES: usize = 8 << 20;
/// Bytes of a blob.
pub const BLOB_BYTES: usize = 8 << 30;
/// Bytes of a version's bundle, and of all its files together.
pub const BUNDLE_BYTES: usize = 256 << 30;
/// Bytes of all calls together, blobs excepted, that are in memory at a time; more wait.
pub const CALLS_BYTES: usize = 32 << 20;
/// Calls of clients that change something (submissions, commands about runs) that wait to be decided; one more is told to come again.
/// Workers' reports stand in the same queue, which must never be long.
pub const CLIENTS_WAITING: usize = 64;
/// Batches of values and log lines that wait to be stored; one more is told to come again.
pub const BATCHES_WAITING: usize = 64;
/// After how many seconds a caller that is told so should come again.
pub const COME_AGAIN_S: u32 = 1;

// Pipelines. The range of each numeric setting of a stage stands beside its name, in `pipeline::ranges`.

/// Bytes of a pipeline file.
pub const PIPELINE_BYTES: u64 = 1 << 20;
/// Values nested in one another, in a pipeline file or in the path of a `--set`.
pub const PIPELINE_DEPTH: usize = 64;
/// Values of a pipeline file and its overrides together, aliases expanded.
pub const PIPELINE_VALUES: usize = 20_000;
/// Bytes of the texts among them, aliases expanded.
pub const PIPELINE_TEXT_BYTES: usize = 4 << 20;
/// Bytes of one text in a pipeline: a path, a gate, a name.
pub const TEXT_BYTES: usize = 8 << 10;
/// Bytes of one key.
pub const KEY_BYTES: usize = 256;
/// Mistakes that are shown of one file.
pub const MISTAKES: usize = 100;
/// Overrides on one command line.
pub const OVERRIDES: usize = 1_000;

/// Tokens of a latent. A VAE's tables have 500 positions: for a mean and a deviation of each token, and for the frames of a clip, of which the longest
/// has fewer than 200.
pub const LATENT_TOKENS: u64 = 150;
/// Shards of one stage.
pub const SHARDS: u64 = 10_000;
/// Shards of all stages of a pipeline.
pub const PIPELINE_SHARDS: u64 = 100_000;
/// Entries of a list among a stage's settings.
pub const LIST: usize = 1_000;
/// Settings that one sweep searches.
pub const SWEPT_SETTINGS: usize = 32;
/// Values in the `choice` lists of all sweeps of a pipeline.
pub const SWEPT_VALUES: usize = 1_000;
/// The same times the pipeline's stages, since each value is checked against all of them.
pub const SWEPT_CHECKS: usize = 100_000;
/// Trials of all sweeps of a pipeline.
pub const TRIALS: usize = 10_000;

/// Parameters of one network: 8 GB of weights, and four times that with gradients and moments.
pub const PARAMETERS: usize = 2_000_000_000;
/// Motions that one evaluation keeps embeddings of, besides one for each entry and repeat.
pub const EVALUATED_MOTIONS: usize = 1_000_000;

/// Repeats of cases that one evaluation of control draws all entries of.
pub const CONTROL_CASES: usize = 10_000;

/// Steps that a drawn latent is refined by.
pub const REFINE_STEPS: usize = 1000;
/// Rounds of feedback on a drawn latent.
pub const FEEDBACK_ROUNDS: usize = 100;

// Files that somebody else made.

/// Bytes of one clip's features.
pub const CLIP_BYTES: u64 = 64 << 20;
/// Bytes of another `.npy` file: statistics, word vectors.
pub const ARRAY_BYTES: u64 = 1 << 30;
/// Bytes of a `.npy` header; NumPy's own have 118.
pub const ARRAY_HEADER_BYTES: usize = 1 << 10;
/// Bytes of the captions of one clip.
pub const CAPTIONS_BYTES: u64 = 1 << 20;
/// Bytes of one line of them.
pub const CAPTION_BYTES: usize = 8 << 10;
/// Bytes of a list of clips.
pub const CLIP_LIST_BYTES: u64 = 64 << 20;
/// Bytes of a clip's name.
pub const CLIP_NAME_BYTES: usize = 200;
/// Clips of a dataset, all lists together.
pub const CLIPS: usize = 1_000_000;
/// Files in a folder of weights and below it.
pub const FOLDER_FILES: usize = 100_000;
/// Folders in one another there.
pub const FOLDER_DEPTH: usize = 64;
/// Bytes of a file of weights that is imported.
pub const WEIGHTS_BYTES: u64 = 2 << 30;
/// Bytes of a pickled vocabulary.
pub const VOCABULARY_BYTES: u64 = 64 << 20;
