//! Captions of a dataset, embedded once.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use super::interface::{MotionGenerator, Text};
use crate::context::StageError;

/// The captions of a dataset in the generator's form, each embedded once.
#[derive(Debug)]
pub(crate) struct Texts<'a> {
    generator: &'a dyn MotionGenerator,
    known: RefCell<BTreeMap<usize, Rc<Text>>>,
}

impl<'a> Texts<'a> {
    pub(crate) fn new(generator: &'a dyn MotionGenerator) -> Self {
        Self { generator, known: RefCell::default() }
    }

    /// Embeds captions by index; `text` returns the words of one.
    pub(crate) fn get<'t>(
        &self,
        numbers: &[usize],
        text: impl Fn(usize) -> &'t str,
    ) -> Result<Vec<Rc<Text>>, StageError> {
        let mut known = self.known.borrow_mut();
        let mut new: Vec<usize> = numbers.iter().copied().filter(|number| !known.contains_key(number)).collect();
        new.sort_unstable();
        new.dedup();
        let words: Vec<&str> = new.iter().map(|number| text(*number)).collect();
        let embedded = self.generator.embed(&words)?;
        known.extend(new.into_iter().zip(embedded.into_iter().map(Rc::new)));
        Ok(numbers.iter().map(|number| Rc::clone(&known[number])).collect())
    }
}
