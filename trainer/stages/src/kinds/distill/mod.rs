//! The kinds `distill.*`: students.

mod discord;
mod lcm;
mod pcm;

runners! {
    Gang: DistillLcm, DistillPcm, DistillDiscord;
}
