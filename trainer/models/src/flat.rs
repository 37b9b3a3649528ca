//! Parameters and gradients as flat f32 buffers in declaration order: what is reduced, clipped, updated, saved and compared.

use std::convert::Infallible;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Gradients, Tensor, TensorData};

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
            self.1.push(Entry { name, shape: param.dims().to_vec() });
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
pub(crate) fn replace<M: Module, E>(module: M, fill: impl FnMut(&mut [f32]) -> Result<(), E>) -> Result<M, E> {
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

/// Adds the gradients of all parameters to `out`, in the order of [`read`]. A parameter that took no part adds nothing.
///
/// # Panics
/// If `out` has another length than the module has parameters.
pub fn add_gradients<M: Module>(module: &M, gradients: &mut Gradients, out: &mut [f32]) {
    struct Add<'a>(&'a mut Gradients, &'a mut [f32], usize);
    impl ModuleVisitor for Add<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            let len = param.dims().iter().product::<usize>();
            if let Some(gradient) = param.val().grad_remove(self.0) {
                let data = gradient.into_data();
                let from = data.as_slice::<f32>().expect("gradients are f32");
                for (o, g) in self.1[self.2..self.2 + len].iter_mut().zip(from) {
                    *o += g;
                }
            }
            self.2 += len;
        }
    }
    let mut visitor = Add(gradients, out, 0);
    module.visit(&mut visitor);
    let (seen, len) = (visitor.2, visitor.1.len());
    assert_eq!(seen, len, "the buffer and the module have different lengths");
}
