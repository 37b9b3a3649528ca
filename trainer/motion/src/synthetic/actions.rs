//! Movements of the synthetic body: one function per movement, from the clip's draw to the pose at a time.
//!
//! Times and sizes depend on the draw (tempo, size, side, a few free numbers), so that no two clips of a movement are
//! equal.

mod draw;
mod fights;
mod gaits;
mod gestures;
mod jumps;

pub(super) use self::draw::{Draw, Motion};
pub(super) use self::fights::{boxing, kick, punch};
pub(super) use self::gaits::{
    crawl, march, run, side_step, sneak, turn_in_place, walk, walk_and_turn, walk_backward, walk_in_circle, zombie,
};
pub(super) use self::gestures::{
    balance, bow, clap, jumping_jacks, pick_up, raise_arms, sit, squat, stretch, throw, wave,
};
pub(super) use self::jumps::{hop, jump, jump_forward};
