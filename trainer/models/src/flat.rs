//! Parameters and gradients as flat f32 buffers in declaration order, for reduction, clipping, updates, storage and
//! comparison.

use std::cell::RefCell;
use std::collections::HashSet;
use std::convert::Infallible;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor, TensorData};

use crate::device::is_accelerator;
#[cfg(feature = "flex")]
use crate::kernels::Collector;
use crate::kernels::with_values;

/// One parameter tensor inside a flat buffer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Published name, such as `blocks.3.weight`.
    pub name: String,
    pub shape: Vec<usize>,
}

impl Entry {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns true if the tensor has no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Containers whose fields are numbered: `main_3` is entry 3 of `main`. `at` has no name of its own: `at_2` is entry 2.
const SEQUENCES: [&str; 7] = ["main", "output", "output_net", "at", "blocks", "time_embed", "time_mlp"];

/// Lists names and shapes in declaration order. Field paths are the published names, with two exceptions: a field
/// `main_3` is `main.3`, and `emb_proj` is `emb_proj.1`, because entry 0 of upstream's sequence has no parameters.
pub fn layout<M: Module>(module: &M) -> Vec<Entry> {
    struct Layout(Vec<String>, Vec<Entry>);
    impl ModuleVisitor for Layout {
        fn enter_module(&mut self, name: &str, container: &str) {
            // The name of an enum's variant is not part of a published path.
            if container.starts_with("Enum:") {
                return self.0.push(String::new());
            }
            // A field named like a Rust keyword is written `r#name`.
            let name = name.strip_prefix("r#").unwrap_or(name);
            let entry =
                name.rsplit_once('_').filter(|(sequence, n)| SEQUENCES.contains(sequence) && n.parse::<u32>().is_ok());
            self.0.push(match entry {
                Some(("at", n)) => n.to_owned(),
                Some((sequence, n)) => format!("{sequence}.{n}"),
                None => name.to_owned(),
            });
        }
        fn exit_module(&mut self, _: &str, _: &str) {
            self.0.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let parts: Vec<&str> = self.0.iter().map(String::as_str).filter(|part| !part.is_empty()).collect();
            let name = parts.join(".");
            let name = match name.strip_prefix("emb_proj.") {
                Some(rest) => format!("emb_proj.1.{rest}"),
                None => name,
            };
            self.1.push(Entry { name, shape: param.lazy_shape().to_vec() });
        }
    }
    let mut visitor = Layout(Vec::new(), Vec::new());
    module.visit(&mut visitor);
    visitor.1
}

/// Reads all parameters, one after the other.
pub fn read<M: Module>(module: &M) -> Vec<f32> {
    struct Read(Vec<f32>);
    impl ModuleVisitor for Read {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            with_values(param.val(), |values| self.0.extend_from_slice(values));
        }
    }
    let mut visitor = Read(Vec::with_capacity(module.num_params()));
    module.visit(&mut visitor);
    visitor.0
}

/// Replaces the module's parameters by `flat`; parameter ids and gradient tracking stay.
///
/// # Panics
/// If `flat` has another length than the module has parameters.
pub fn write<M: Module>(module: M, mut flat: &[f32]) -> M {
    let Ok(module) = renew(module, |count| {
        let (head, tail) = flat.split_at(count);
        flat = tail;
        Ok::<_, Infallible>(head.to_vec())
    });
    assert!(flat.is_empty(), "the buffer is longer than the module");
    module
}

/// Replaces the module's parameters by the values that `fill` writes, tensor by tensor; ids and gradient tracking stay.
/// After an error `fill` is not called again.
///
/// # Errors
/// The first error of `fill`.
pub fn replace<M: Module, E>(module: M, mut fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<M, E> {
    renew(module, |count| {
        let mut values = vec![0.0; count];
        fill(&mut values)?;
        Ok(values)
    })
}

/// Replaces the module's parameters by values of `next`, which gets the number of values of each.
fn renew<M: Module, E>(module: M, next: impl FnMut(usize) -> Result<Vec<f32>, E>) -> Result<M, E> {
    struct Renew<F, E> {
        next: F,
        failed: Option<E>,
    }
    impl<F: FnMut(usize) -> Result<Vec<f32>, E>, E> ModuleMapper for Renew<F, E> {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            if self.failed.is_some() {
                return param;
            }
            let shape = param.dims();
            let values = match (self.next)(shape.iter().product()) {
                Ok(values) => values,
                Err(error) => {
                    self.failed = Some(error);
                    return param;
                }
            };
            let data = TensorData::new(values, shape);
            param.map(|old| {
                let tracked = old.is_require_grad();
                Tensor::from_data(data, &old.device()).set_require_grad(tracked)
            })
        }
    }
    let mut mapper = Renew { next, failed: None };
    let module = module.map(&mut mapper);
    mapper.failed.map_or(Ok(module), Err)
}

/// Replaces the parameters of `module` by `flat` like [`write`], but never holds all old and all new tensors in memory.
///
/// # Panics
/// As [`write`].
pub fn assign<M: Module>(module: &mut M, flat: &[f32]) {
    struct Hollow;
    impl ModuleMapper for Hollow {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            param.map(|old| Tensor::zeros([1; D], &old.device()))
        }
    }
    // Clones share their tensors, and a shared tensor is never freed. So the only complete module is moved out.
    let hollow = module.clone().map(&mut Hollow);
    let whole = std::mem::replace(module, hollow);
    *module = write(whole, flat);
}

/// Parameters as one flat buffer, on the host or on an accelerator.
#[derive(Debug, Clone, Copy)]
pub enum Values<'a> {
    /// A slice in host memory.
    Host(&'a [f32]),
    /// A tensor [N] on an accelerator, without autodiff.
    Device(&'a Tensor<1>),
}

impl Values<'_> {
    /// Number of parameters.
    pub fn len(self) -> usize {
        match self {
            Self::Host(values) => values.len(),
            Self::Device(values) => values.dims()[0],
        }
    }

    /// Returns true if the buffer has no elements.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Replaces the parameters of `module`, as [`assign`] does.
    ///
    /// # Panics
    /// If the buffer has another length than the module has parameters.
    pub fn assign<M: Module>(self, module: &mut M) {
        assert_eq!(self.len(), module.num_params(), "parameters of the module");
        self.assign_first(module);
    }

    /// Replaces the parameters of `module` by the first values of the buffer.
    ///
    /// # Panics
    /// If the buffer is shorter than the module's parameters.
    pub fn assign_first<M: Module>(self, module: &mut M) {
        match self {
            Self::Host(values) => assign(module, &values[..module.num_params()]),
            Self::Device(values) => *module = module.clone().map(&mut Cut { values, at: 0 }),
        }
    }
}

/// Cuts parameters from a flat tensor on its device.
struct Cut<'a> {
    values: &'a Tensor<1>,
    at: usize,
}

impl ModuleMapper for Cut<'_> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let shape = param.dims();
        let end = self.at + shape.iter().product::<usize>();
        let new = self.values.clone().slice(self.at..end).reshape(shape);
        self.at = end;
        param.map(|old| {
            let tracked = old.is_require_grad();
            if old.device().is_autodiff() { new.autodiff().set_require_grad(tracked) } else { new }
        })
    }
}

/// Room behind a network's gradients for the values that a step sends with them.
const ROOM: usize = 4096;

/// Buffers that a thread keeps for its next gradients.
const SPARES: usize = 4;

thread_local! {
    static SPARE: RefCell<Vec<Vec<f32>>> = const { RefCell::new(Vec::new()) };
}

/// Keeps the memory of a buffer for the next gradients of this thread, so that it is neither freed nor zeroed.
pub fn recycle(buffer: Vec<f32>) {
    SPARE.with_borrow_mut(|spare| {
        if spare.len() < SPARES && buffer.capacity() > 0 {
            spare.push(buffer);
        }
    });
}

/// A buffer of `len` values of any content. A few thousand can be appended without a copy. [`recycle`] it.
pub fn buffer(len: usize) -> Vec<f32> {
    let fits = |spare: &Vec<f32>| (len..=len + 2 * ROOM).contains(&spare.capacity());
    let spare = SPARE.with_borrow_mut(|spares| spares.iter().position(fits).map(|at| spares.swap_remove(at)));
    let mut buffer = spare.unwrap_or_else(|| Vec::with_capacity(len + ROOM));
    buffer.resize(len, 0.0);
    buffer
}

/// The gradient of `loss` for all parameters, in the order of [`read`]; zeros for a parameter without one. On flex, most
/// of it is written as the backward pass goes. [`recycle`] the result.
pub fn gradient<M: Module>(module: &M, loss: Tensor<1>) -> Vec<f32> {
    let out = buffer(module.num_params());
    #[cfg(feature = "flex")]
    {
        struct Places(Collector, usize);
        impl ModuleVisitor for Places {
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                let end = self.1 + param.dims().iter().product::<usize>();
                self.0.add(&param.val(), self.1..end);
                self.1 = end;
            }
        }
        let mut places = Places(Collector::new(out), 0);
        module.visit(&mut places);
        let (mut gradients, out, written) = places.0.during(|| loss.backward());
        take_rest(module, &mut gradients, out, &written.into_iter().map(|place| place.start).collect())
    }
    #[cfg(not(feature = "flex"))]
    take_rest(module, &mut loss.backward(), out, &HashSet::new())
}

/// Takes the gradients of all parameters, in the order of [`read`]; zeros for a parameter without one.
pub fn take_gradients<M: Module>(module: &M, gradients: &mut Gradients) -> Vec<f32> {
    take_rest(module, gradients, buffer(module.num_params()), &HashSet::new())
}

/// Fills `out` with gradients. The ones that begin at `written` are there already, and later uses are added to them.
fn take_rest<M: Module>(module: &M, gradients: &mut Gradients, out: Vec<f32>, written: &HashSet<usize>) -> Vec<f32> {
    struct Take<'a> {
        gradients: &'a mut Gradients,
        written: &'a HashSet<usize>,
        out: Vec<f32>,
        at: usize,
        /// Gradients on an accelerator with their offsets in `out`; one transfer copies them all.
        there: Vec<(usize, Tensor<1>)>,
    }
    impl ModuleVisitor for Take<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let (at, len) = (self.at, param.dims().iter().product::<usize>());
            self.at += len;
            let out = &mut self.out[at..self.at];
            let is_written = len > 0 && self.written.contains(&at);
            match param.val().grad_remove(self.gradients).map(|gradient| gradient.reshape([len])) {
                Some(gradient) if is_accelerator(&gradient.device()) => self.there.push((at, gradient)),
                Some(gradient) => with_values(gradient, |from| {
                    if is_written {
                        out.iter_mut().zip(from).for_each(|(out, from)| *out += from);
                    } else {
                        out.copy_from_slice(from);
                    }
                }),
                None if is_written => {}
                None => out.fill(0.0),
            }
        }
    }
    let mut visitor = Take { gradients, written, out, at: 0, there: Vec::new() };
    module.visit(&mut visitor);
    let Take { mut out, there, .. } = visitor;
    if !there.is_empty() {
        let (places, tensors): (Vec<_>, Vec<_>) = there.into_iter().map(|(at, t)| ((at, t.dims()[0]), t)).unzip();
        with_values(Tensor::cat(tensors, 0), |mut from| {
            for (at, len) in places {
                let (head, tail) = from.split_at(len);
                out[at..at + len].copy_from_slice(head);
                from = tail;
            }
        });
    }
    out
}
