//! Colours of the pictures.

use super::raster::Colour;

pub(super) const PAPER: Colour = [250, 250, 248];
pub(super) const INK: Colour = [40, 42, 48];
pub(super) const FAINT: Colour = [120, 124, 132];
pub(super) const GRID: Colour = [222, 223, 224];
pub(super) const TRAIL: Colour = [150, 170, 150];
pub(super) const SHADOW: Colour = [205, 206, 208];
pub(super) const BODY: Colour = [70, 74, 84];
pub(super) const LEFT: Colour = [36, 110, 200];
pub(super) const RIGHT: Colour = [214, 84, 48];
pub(super) const TOLD: Colour = [140, 60, 160];
