//! The kinds `model.*`: models made from parts.

mod decoder;

runners! {
    Plain: ModelDecoder;
}
