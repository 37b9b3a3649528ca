//! The kinds `encode.*`: datasets as latents and tokens.

mod latents;
mod tokens;

runners! {
    Map: EncodeLatents, EncodeTokens;
}
