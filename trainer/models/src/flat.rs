//! Parameters and gradients as flat f32 buffers in declaration order: what is reduced, clipped, updated, saved and compared.

use std::convert::Infallible;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor, TensorData};

use crate::device::is_accelerator;

/// One parameter tensor inside a flat buffer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Published name.
    pub name: String,
    /// Shape.
    pub shape: Vec<usize>,
}

impl Entry {
    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Sequences whose fields are numbered: `main_3` is entry 3 of `main`. Those of `at` have no name of their own: `at_2` is entry 2.
const SEQUENCES: [&str; 7] = ["main", "output", "output_net", "at", "blocks", "time_embed", "time_mlp"];

/// Names and shapes in declaration order. Paths are the published names, but for entries of upstream's sequences, whose others
/// have no parameters: `emb_proj` is `emb_proj.1`, and a field `main_3` is `main.3`.
pub fn layout<M: Module>(module: &M) -> Vec<Entry> {
    struct Layout(Vec<String>, Vec<Entry>);
    impl ModuleVisitor for Layout {
        fn enter_module(&mut self, name: &str, container: &str) {
            // Which variant an entry of a sequence is has no place in its name.
            if container.starts_with("Enum:") {
                return self.0.push(String::new());
            }
            // A name that is a word of Rust's.
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

/// All parameters, one after the other.
pub fn read<M: Module>(module: &M) -> Vec<f32> {
    struct Read(Vec<f32>);
    impl ModuleVisitor for Read {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let data = param.val().into_data();
            self.0.extend_from_slice(data.as_slice::<f32>().expect("parameters are f32"));
        }
    }
    let mut visitor = Read(Vec::with_capacity(module.num_params()));
    module.visit(&mut visitor);
    visitor.0
}

/// The module with its parameters replaced by `flat`; identities and gradient tracking stay.
///
/// # Panics
/// If `flat` has another length than the module has parameters.
pub fn write<M: Module>(module: M, mut flat: &[f32]) -> M {
    let Ok(module) = replace(module, |values| {
        let (head, tail) = flat.split_at(values.len());
        values.copy_from_slice(head);
        flat = tail;
        Ok::<_, Infallible>(())
    });
    assert!(flat.is_empty(), "the buffer is longer than the module");
    module
}

/// The module with the parameters that `fill` gives, one after the other; identities and gradient tracking stay. After an error it is
/// asked no more.
///
/// # Errors
/// What `fill` says.
pub fn replace<M: Module, E>(module: M, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<M, E> {
    struct Replace<F, E> {
        fill: F,
        failed: Option<E>,
    }
    impl<F: FnMut(&mut [f32]) -> Result<(), E>, E> ModuleMapper for Replace<F, E> {
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            if self.failed.is_some() {
                return param;
            }
            let shape = param.dims();
            let mut values = vec![0.0; shape.iter().product()];
            if let Err(error) = (self.fill)(&mut values) {
                self.failed = Some(error);
                return param;
            }
            let data = TensorData::new(values, shape);
            param.map(|old| {
                let tracked = old.is_require_grad();
                Tensor::from_data(data, &old.device()).set_require_grad(tracked)
            })
        }
    }
    let mut mapper = Replace { fill, failed: None };
    let module = module.map(&mut mapper);
    mapper.failed.map_or(Ok(module), Err)
}

/// Replaces the parameters of `module` by `flat`, as [`write`] does, tensor by tensor: old and new ones are not all in memory together.
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
    // Clones share their tensors, and what is shared is freed by nobody: the only whole one is taken out.
    let hollow = module.clone().map(&mut Hollow);
    let whole = std::mem::replace(module, hollow);
    *module = write(whole, flat);
}

/// Parameters as one flat buffer, where they are.
#[derive(Debug, Clone, Copy)]
pub enum Values<'a> {
    /// On the host.
    Host(&'a [f32]),
    /// On an accelerator, without autodiff: [N].
    Device(&'a Tensor<1>),
}

impl Values<'_> {
    /// How many.
    pub fn len(self) -> usize {
        match self {
            Self::Host(values) => values.len(),
            Self::Device(values) => values.dims()[0],
        }
    }

    /// Whether there are none.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Replaces the parameters of `module`, as [`assign`] does.
    ///
    /// # Panics
    /// If these are not as many as the module's parameters.
    pub fn assign<M: Module>(self, module: &mut M) {
        assert_eq!(self.len(), module.num_params(), "parameters of the module");
        self.assign_first(module);
    }

    /// Replaces the parameters of `module` by the first of these.
    ///
    /// # Panics
    /// If these are less than the module's parameters.
    pub fn assign_first<M: Module>(self, module: &mut M) {
        match self {
            Self::Host(values) => assign(module, &values[..module.num_params()]),
            Self::Device(values) => *module = module.clone().map(&mut Cut { values, at: 0 }),
        }
    }
}

/// Cuts parameters from a flat tensor on their device.
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

/// Adds the gradients of all parameters to `out`, in the order of [`read`]. A parameter that took no part adds nothing.
///
/// # Panics
/// If `out` has another length than the module has parameters.
pub fn add_gradients<M: Module>(module: &M, gradients: &mut Gradients, out: &mut [f32]) {
    struct Add<'a> {
        gradients: &'a mut Gradients,
        out: &'a mut [f32],
        at: usize,
        /// What lies on an accelerator, and where it belongs: it comes over together.
        there: Vec<(usize, Tensor<1>)>,
    }
    fn add(gradient: Tensor<1>, mut to: impl FnMut(&[f32])) {
        to(gradient.into_data().as_slice::<f32>().expect("gradients are f32"));
    }
    fn sum(to: &mut [f32], from: &[f32]) {
        to.iter_mut().zip(from).for_each(|(o, g)| *o += g);
    }
    impl ModuleVisitor for Add<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let len = param.dims().iter().product::<usize>();
            if let Some(gradient) = param.val().grad_remove(self.gradients) {
                let gradient = gradient.reshape([len]);
                if is_accelerator(&gradient.device()) {
                    self.there.push((self.at, gradient));
                } else {
                    add(gradient, |from| sum(&mut self.out[self.at..self.at + len], from));
                }
            }
            self.at += len;
        }
    }
    let mut visitor = Add { gradients, out, at: 0, there: Vec::new() };
    module.visit(&mut visitor);
    let Add { out, at: seen, there, .. } = visitor;
    assert_eq!(seen, out.len(), "the buffer and the module have different lengths");
    if there.is_empty() {
        return;
    }
    let (places, tensors): (Vec<_>, Vec<_>) = there.into_iter().map(|(at, t)| ((at, t.dims()[0]), t)).unzip();
    add(Tensor::cat(tensors, 0), |mut from| {
        for (at, len) in &places {
            let (head, tail) = from.split_at(*len);
            sum(&mut out[*at..at + len], head);
            from = tail;
        }
    });
}
