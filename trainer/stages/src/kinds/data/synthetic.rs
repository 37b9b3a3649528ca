//! `data.synthetic`: stores a dataset of motions that the program makes.

use std::cell::RefCell;

use protocol::Digest;
use protocol::stage::{DataFormat, DataSynthetic};

use crate::context::{AttemptContext, Outcome, StageError};
use crate::dataset::pack;
use crate::kinds::shape::Plain;
use crate::stand_in;

impl Plain for DataSynthetic {
    fn stand_in(&self, cx: &mut dyn AttemptContext) -> Option<Result<Digest, StageError>> {
        Some(stand_in::dataset(cx, DataFormat::Humanml3d))
    }

    fn run(&self, cx: &mut dyn AttemptContext) -> Result<Outcome, StageError> {
        if self.clips == 0 {
            return Err(StageError::Input("`clips` is 0; expected at least 1".into()));
        }
        let seed = cx.task().seed;
        let clips = self.clips as u64;
        let world = RefCell::new(&mut *cx);
        let go_on = |made: usize| {
            let mut cx = world.borrow_mut();
            cx.progress(made as u64, clips, "clips", &[]);
            !cx.interrupted()
        };
        let made = motion::synthetic::generate_while(self, seed, &go_on);
        let Some(dataset) = made else { return Ok(Outcome::Yielded { at: 0 }) };
        let text = format!("made by the program: {} clips, {} captions\n", dataset.clips.len(), dataset.captions.len());
        pack(cx, &dataset, 0, text, vec![])
    }
}
