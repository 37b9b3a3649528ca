//! The kinds `text.*`: captions.

mod embed;

runners! {
    Map: TextEmbed;
}
