//! Motion of other programs: recordings in, animations out. No tensors, no stages.
