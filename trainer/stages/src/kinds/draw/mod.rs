//! The kinds `draw.*`: motions to be looked at.

mod motions;

runners! {
    Plain: DrawMotions;
}
