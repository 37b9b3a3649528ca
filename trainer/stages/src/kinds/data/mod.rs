//! The kinds `data.*`: datasets.

mod features;
mod fold;
mod open;
mod synthetic;

runners! {
    Plain: DataFold, DataOpen, DataSynthetic;
    Map: DataFeatures;
}
