//! Limits of the system, in one place. Anything beyond a limit is refused with a message that names it.
//!
//! A limit is chosen so that no honest use comes near it and no hostile use can block others.

/// Largest number of stages of a submitted pipeline. Stages that a sweep adds during its run are limited by
/// [`MAX_TRIALS`](crate::sweep::MAX_TRIALS) instead.
pub const STAGES: usize = 1_000;
/// Copies of a stage by `seeds`.
pub const SEEDS: usize = 100;
/// Highest priority of a run; its negative is the lowest. It is low because a decision compares the waiting work of each
/// priority.
pub const PRIORITY: i32 = 100;

/// Largest size in bytes of a small call: a poll, the end of a checkpoint or a task, a command.
pub const CALL_BYTES: usize = 1 << 20;
/// Largest size in bytes of a batch of values or of log lines.
pub const BATCH_BYTES: usize = 4 << 20;
/// Largest number of values, or of log lines, of a batch.
pub const BATCH_ENTRIES: usize = 10_000;
/// Largest size in bytes of a submission, which holds its pipeline as written and as read.
pub const SUBMISSION_BYTES: usize = 8 << 20;
/// Largest size of a blob, in bytes. Earlier builds stored a file as one blob.
pub const BLOB_BYTES: usize = 8 << 30;
/// Largest size in bytes of a small blob. It is sent in one call, passes through the server even where others pass it by,
/// and may be cached as a whole.
pub const SMALL_BLOB_BYTES: u64 = 64 << 10;
/// Size in bytes of the blobs of a file, except its last one. It is part of the digest of an artifact with a longer
/// file, so a change of it changes what a stage gives.
pub const CHUNK_BYTES: u64 = 1 << 30;
/// Largest number of blobs of a file. A reader holds each of them open.
pub const FILE_CHUNKS: usize = 512;
/// Largest size of a file of an artifact, in bytes: 512 GiB.
pub const FILE_BYTES: u64 = FILE_CHUNKS as u64 * CHUNK_BYTES;
/// Largest size in bytes of a version's bundle, and of all its files together.
pub const BUNDLE_BYTES: usize = 256 << 30;
/// Largest total size in bytes of all calls in memory at a time, without blobs; further calls wait.
pub const CALLS_BYTES: usize = 32 << 20;
/// Largest number of waiting client calls that change something (submissions, commands on runs); a further one must
/// retry. Workers' reports are in the same queue, which must stay short.
pub const CLIENTS_WAITING: usize = 64;
/// Largest number of batches of values and log lines waiting to be stored; a further one must retry.
pub const BATCHES_WAITING: usize = 64;
/// Largest number of calls that read much of the tables (lists of runs, curves, log lines) answered at a time.
pub const READS_AT_ONCE: usize = 2;
/// Largest number of such calls that wait; a further one must retry.
pub const READS_WAITING: usize = 64;
/// Largest number of runs in one answer; `after` asks for further ones.
pub const RUNS_LISTED: u32 = 500;
/// Largest size in bytes of the words that runs are searched for.
pub const SEARCH_BYTES: usize = 256;
/// Largest number of log lines in one answer; `after` asks for later ones.
pub const LINES_READ: u32 = 10_000;
/// Largest number of rows of history in one answer; `after` asks for later ones.
pub const HISTORY_READ: u32 = 10_000;
/// Largest number of seconds that a call for history waits for rows.
pub const HISTORY_WAIT_S: u32 = 30;
/// Largest number of open streams of events, and of those of one token.
pub const STREAMS: usize = 512;
pub const STREAMS_OF_TOKEN: usize = 64;
/// Largest number of rows that a stream of events catches up with; a client further behind begins anew.
pub const EVENTS_BEHIND: u32 = 10_000;
/// Largest number of points of one curve in a packed answer.
pub const PACKED_POINTS: usize = 1_000_000;
/// Largest number of points of one curve in an answer; `after` asks for later ones.
pub const CURVE_POINTS: usize = 10_000;
/// Largest number of buckets of one curve.
pub const CURVE_BUCKETS: usize = 4_000;
/// Largest number of buckets of all curves in an answer.
pub const CURVE_CELLS: usize = 200_000;
/// Largest number of runs whose curves are in one answer.
pub const CURVE_RUNS: usize = 50;
/// Largest number of labels of a worker, and of required labels of a stage.
pub const LABELS: usize = 16;
/// Largest number of seconds that a call for demand waits for a change.
pub const DEMAND_WAIT_S: u32 = 30;
/// Largest number of launchers of one server.
pub const LAUNCHERS: usize = 256;
/// Largest number of models of one draw.
pub const DRAW_MODELS: usize = 4;
/// Largest number of sentences of one draw.
pub const DRAW_SENTENCES: usize = 8;
/// Largest number of motions of one sentence of a draw.
pub const DRAW_COUNT: usize = 16;
/// Largest number of unfinished draws of one owner; a further one must retry.
pub const DRAWS_WAITING_EACH: usize = 4;
/// Largest number of unfinished draws of all owners.
pub const DRAWS_WAITING: usize = 64;
/// Seconds after which a caller should retry.
pub const COME_AGAIN_S: u32 = 1;

// Limits of pipelines. The range of each numeric setting of a stage stands beside its field.

/// Largest size of a pipeline file, in bytes.
pub const PIPELINE_BYTES: u64 = 1 << 20;
/// Largest nesting of values in a pipeline file or in the path of a `--set`.
pub const PIPELINE_DEPTH: usize = 64;
/// Largest number of values in a pipeline file and its overrides, aliases expanded.
pub const PIPELINE_VALUES: usize = 20_000;
/// Largest size in bytes of the texts among them, aliases expanded.
pub const PIPELINE_TEXT_BYTES: usize = 4 << 20;
/// Largest size in bytes of one text in a pipeline: a path, a gate, a name.
pub const TEXT_BYTES: usize = 8 << 10;
/// Largest size of a key, in bytes.
pub const KEY_BYTES: usize = 256;
/// Largest number of mistakes shown for one file.
pub const MISTAKES: usize = 100;
/// Largest number of overrides on one command line.
pub const OVERRIDES: usize = 1_000;

/// Largest number of tokens of a latent. A VAE's tables have 500 positions, for a mean and a deviation of each token
/// and for the frames of a clip. The longest clip has fewer than 200 frames.
pub const LATENT_TOKENS: u64 = 150;
/// Largest number of shards of one stage.
pub const SHARDS: u64 = 10_000;
/// Largest number of shards of all stages of a pipeline.
pub const PIPELINE_SHARDS: u64 = 100_000;
/// Largest number of entries of a list in a stage's settings.
pub const LIST: usize = 1_000;
/// Largest number of settings that one sweep searches.
pub const SWEPT_SETTINGS: usize = 32;
/// Largest number of values in the `choice` lists of all sweeps of a pipeline.
pub const SWEPT_VALUES: usize = 1_000;
/// Largest product of those values and the pipeline's stages, since each value is checked against all stages.
pub const SWEPT_CHECKS: usize = 100_000;
/// Largest number of trials of all sweeps of a pipeline.
pub const TRIALS: usize = 10_000;

/// Largest number of parameters of one network: 8 GB of weights, four times that with gradients and moments.
pub const PARAMETERS: usize = 2_000_000_000;
/// Largest number of motions whose embeddings one evaluation keeps, besides one for each entry and repeat.
pub const EVALUATED_MOTIONS: usize = 1_000_000;

/// Largest number of cases times repeats of one control evaluation, each over all entries.
pub const CONTROL_CASES: usize = 10_000;

/// Largest number of steps that refine a sampled latent.
pub const REFINE_STEPS: usize = 1000;
/// Largest number of rounds of feedback on a sampled latent.
pub const FEEDBACK_ROUNDS: usize = 100;

// Limits of untrusted files.

/// Largest size in bytes of one clip's features.
pub const CLIP_BYTES: u64 = 64 << 20;
/// Largest size in bytes of another `.npy` file: statistics, word vectors.
pub const ARRAY_BYTES: u64 = 1 << 30;
/// Largest size of a `.npy` header in bytes; NumPy's own have 118.
pub const ARRAY_HEADER_BYTES: usize = 1 << 10;
/// Largest size in bytes of the captions of one clip.
pub const CAPTIONS_BYTES: u64 = 1 << 20;
/// Largest size in bytes of one line of captions.
pub const CAPTION_BYTES: usize = 8 << 10;
/// Largest size in bytes of a list of clips.
pub const CLIP_LIST_BYTES: u64 = 64 << 20;
/// Largest size in bytes of a clip's name.
pub const CLIP_NAME_BYTES: usize = 200;
/// Largest number of clips of a dataset in all lists.
pub const CLIPS: usize = 1_000_000;
/// Largest number of files in a folder of weights and below it.
pub const FOLDER_FILES: usize = 100_000;
/// Largest nesting of folders there.
pub const FOLDER_DEPTH: usize = 64;
/// Largest size in bytes of an imported file of weights.
pub const WEIGHTS_BYTES: u64 = 2 << 30;
/// Largest size in bytes of a pickled vocabulary.
pub const VOCABULARY_BYTES: u64 = 64 << 20;
