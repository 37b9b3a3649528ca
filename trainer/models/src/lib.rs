//! The published networks, their samplers, and the CPU kernels under them.
//!
//! Not its job: stages, stores, workers, where data comes from.

pub mod device;
pub mod diffusion;
pub mod flat;
pub mod kernels;
pub mod losses;
pub mod names;
pub mod networks;
pub mod optim;

/// The instruction set that the kernels of this process use, which can change bits.
pub fn instruction_set() -> &'static str {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            return "x86-64 avx512";
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            return "x86-64 avx2";
        }
    }
    std::env::consts::ARCH
}
