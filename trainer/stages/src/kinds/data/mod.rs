//! The kinds `data.*`: datasets.

mod features;
mod open;
mod synthetic;

runners! {
    Plain: DataOpen, DataSynthetic;
    Map: DataFeatures;
}
