//! The side of a fused kernel that faces Burn: where its tensors live, and how its gradient joins the backward pass.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::fmt::Debug;
use std::ops::Range;

use burn::backend::autodiff::NodeId;
use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::NoCheckpointing};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::{Autodiff, BackendTypes, Flex};
use burn::tensor::{Tensor, TensorData};

use super::simd::add_rows;

/// The CPU backend under autodiff.
type Tracked = Autodiff<Flex, NoCheckpointing>;

/// A function of N tensors with a hand-written gradient. Its tensors are contiguous and f32.
pub(super) trait Fused<const N: usize>: Clone + Debug + Send + 'static {
    /// Tensors that the backward pass reads.
    type Kept: Clone + Debug + Send + 'static;

    /// The function's value, and what its backward pass reads.
    fn forward(&self, inputs: [FlexTensor; N]) -> (FlexTensor, Self::Kept);

    /// The value alone, with the bits of [`forward`](Self::forward).
    fn value(&self, inputs: [FlexTensor; N]) -> FlexTensor {
        self.forward(inputs).0
    }

    /// The gradients of the inputs that are `wanted`, from the output's gradient `dy`. A kernel has this function or
    /// [`backward_to`](Self::backward_to).
    fn backward(&self, kept: Self::Kept, dy: FlexTensor, wanted: [bool; N]) -> [Option<FlexTensor>; N] {
        self.backward_to(kept, dy, wanted, [const { None }; N])
    }

    /// As [`backward`](Self::backward). The gradient of an input that has a place may be written there instead of returned;
    /// the place's old content is not read. An input that has a place and is left out of the result counts as written.
    fn backward_to(
        &self,
        kept: Self::Kept,
        dy: FlexTensor,
        wanted: [bool; N],
        _places: Places<'_, N>,
    ) -> [Option<FlexTensor>; N] {
        self.backward(kept, dy, wanted)
    }
}

/// For each input of a kernel, the place of its gradient in the buffer of all gradients, if it is a parameter's first.
pub(super) type Places<'a, const N: usize> = [Option<&'a mut [f32]>; N];

/// An input of a kernel.
pub(super) enum Input {
    /// A tensor on the tape.
    Tracked(<Tracked as BackendTypes>::FloatTensorPrimitive),
    /// A tensor without a tape, which takes part as a constant.
    Plain(FlexTensor),
}

impl<const D: usize> From<Tensor<D>> for Input {
    fn from(x: Tensor<D>) -> Self {
        match x.clone().try_into_primitive::<Tracked>() {
            Ok(tracked) => Self::Tracked(tracked),
            Err(_) => Self::Plain(x.try_into_primitive::<Flex>().expect("tensors of one call live on one backend")),
        }
    }
}

/// A kernel as an operation of the tape.
#[derive(Debug)]
struct Taped<K>(K);

impl<K: Fused<N>, const N: usize> Backward<Flex, N> for Taped<K> {
    type State = K::Kept;

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let parents = ops.parents.each_ref().map(|parent| parent.as_ref().map(|parent| parent.id));
        let found = Collector::lend(parents, |places| self.0.backward_to(ops.state, dy, wanted, places));
        for (parent, gradient) in ops.parents.into_iter().zip(found) {
            if let (Some(parent), Some(gradient)) = (parent, gradient)
                && !Collector::takes(parent.id, &gradient)
            {
                grads.register::<Flex>(parent.id, gradient);
            }
        }
    }
}

/// Computes `kernel` of `inputs`: one node of the tape if any of them is on it.
pub(super) fn run<const N: usize, const D: usize, K: Fused<N>>(kernel: K, inputs: [Input; N]) -> Tensor<D> {
    if inputs.iter().all(|input| matches!(input, Input::Plain(_))) {
        let inputs = inputs.map(|input| match input {
            Input::Plain(x) => contiguous(x),
            Input::Tracked(x) => contiguous(x.into_primitive()),
        });
        return Tensor::from_primitive::<Flex>(kernel.value(inputs));
    }
    let inputs = inputs.map(|input| match input {
        Input::Tracked(x) => x,
        Input::Plain(x) => <Tracked as BackendTypes>::FloatTensorPrimitive::new(x),
    });
    let nodes = inputs.each_ref().map(|x| x.node());
    let inputs = inputs.map(|x| contiguous(x.into_primitive()));
    let out = match Taped(kernel.clone()).prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prep) => {
            let (out, kept) = kernel.forward(inputs);
            prep.finish(kept, out)
        }
        OpsKind::UnTracked(prep) => prep.finish(kernel.value(inputs)),
    };
    Tensor::from_primitive::<Tracked>(out)
}

thread_local! {
    static STOCK: Cell<bool> = const { Cell::new(false) };
    static COLLECTOR: RefCell<Option<Collector>> = const { RefCell::new(None) };
}

/// Copies gradients of parameters into one buffer as a backward pass makes them. Burn would keep each as a tensor to the
/// end of the pass, and the parameters' memory would be needed once more.
#[derive(Debug)]
pub(crate) struct Collector {
    /// The place of each parameter, and true if its gradient is there.
    places: HashMap<NodeId, (Range<usize>, bool)>,
    values: Vec<f32>,
}

impl Collector {
    /// Writes into `values`, whose old content is not read.
    pub(crate) fn new(values: Vec<f32>) -> Self {
        Self { places: HashMap::new(), values }
    }

    /// Collects the gradient of `parameter` at `place`, if the tensor is on the tape of the CPU backend.
    pub(crate) fn add<const D: usize>(&mut self, parameter: &Tensor<D>, place: Range<usize>) {
        if let Ok(tracked) = parameter.clone().try_into_primitive::<Tracked>() {
            self.places.insert(tracked.node().id(), (place, false));
        }
    }

    /// Collects during `backward`, which stays on this thread. Returns the values, and the places that were written.
    pub(crate) fn during<T>(self, backward: impl FnOnce() -> T) -> (T, Vec<f32>, Vec<Range<usize>>) {
        COLLECTOR.set(Some(self));
        let result = backward();
        let Self { places, values } = COLLECTOR.take().expect("set above");
        let written = places.into_values().filter_map(|(place, is_there)| is_there.then_some(place)).collect();
        (result, values, written)
    }

    /// Lends `write` the places of the parameters that have no gradient yet. Those whose gradient it leaves out are there.
    fn lend<const N: usize>(
        ids: [Option<NodeId>; N],
        write: impl FnOnce(Places<'_, N>) -> [Option<FlexTensor>; N],
    ) -> [Option<FlexTensor>; N] {
        COLLECTOR.with_borrow_mut(|collector| {
            let Some(Self { places, values }) = collector else { return write([const { None }; N]) };
            let free = |id: &NodeId| places.get(id).filter(|(_, is_there)| !is_there).map(|(place, _)| place.clone());
            let ranges = ids.each_ref().map(|id| id.as_ref().and_then(free));
            let whole = ranges.clone().map(Option::unwrap_or_default);
            // An input that is used twice in one call has one place.
            let Ok(lent) = values.get_disjoint_mut(whole) else { return write([const { None }; N]) };
            let mut lent = lent.into_iter();
            let places_of = ranges.each_ref().map(|range| lent.next().filter(|_| range.is_some()));
            let found = write(places_of);
            for ((id, range), gradient) in ids.iter().zip(&ranges).zip(&found) {
                if let (Some(id), Some(_), None) = (id, range, gradient) {
                    places.get_mut(id).expect("it was lent").1 = true;
                }
            }
            found
        })
    }

    /// Takes a gradient, or adds it if the parameter has several uses. Returns false if it is not one to collect.
    fn takes(id: NodeId, gradient: &FlexTensor) -> bool {
        COLLECTOR.with_borrow_mut(|collector| {
            let Some(Self { places, values }) = collector else { return false };
            let Some((place, is_there)) = places.get_mut(&id) else { return false };
            let gradient = contiguous(gradient.clone());
            let (to, from) = (&mut values[place.clone()], slice(&gradient));
            if *is_there {
                to.iter_mut().zip(from).for_each(|(to, from)| *to += from);
            } else {
                to.copy_from_slice(from);
            }
            *is_there = true;
            true
        })
    }
}

/// Runs `body` without fused kernels on this thread.
pub(super) fn stock<T>(body: impl FnOnce() -> T) -> T {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            STOCK.set(self.0);
        }
    }
    let _restore = Restore(STOCK.replace(true));
    body()
}

/// Returns true if a call with `x` runs fused: `x` is on flex, with or without a tape.
pub(super) fn takes<const D: usize>(x: &Tensor<D>) -> bool {
    !STOCK.get()
        && (x.clone().try_into_primitive::<Tracked>().is_ok() || x.clone().try_into_primitive::<Flex>().is_ok())
}

/// A tensor on flex without its tape, in row-major order.
pub(super) fn plain<const D: usize>(x: &Tensor<D>) -> Option<FlexTensor> {
    let tracked = x.clone().try_into_primitive::<Tracked>().map(|x| x.into_primitive());
    tracked.or_else(|_| x.clone().try_into_primitive::<Flex>()).ok().map(contiguous)
}

/// The elements of `x` in row-major order; copies only if `x` is a view.
fn contiguous(x: FlexTensor) -> FlexTensor {
    if x.as_slice::<f32>().is_some() { x } else { x.to_contiguous() }
}

/// The elements of a contiguous tensor.
pub(super) fn slice(x: &FlexTensor) -> &[f32] {
    x.as_slice::<f32>().expect("made contiguous, f32 throughout")
}

/// Has `change` overwrite the elements of a contiguous tensor: in place, unless another tensor shares them.
pub(super) fn overwrite(x: FlexTensor, change: impl FnOnce(&mut [f32])) -> FlexTensor {
    let count = slice(&x).len();
    let mut x = if x.storage::<f32>().len() == count { x } else { make(slice(&x).to_vec(), &shape(&x)) };
    change(x.storage_mut::<f32>());
    x
}

/// The sizes of a tensor's axes.
pub(super) fn shape(x: &FlexTensor) -> Vec<usize> {
    x.layout().shape().to_vec()
}

/// Makes a tensor of `values` in `shape`.
pub(super) fn make(values: Vec<f32>, shape: &[usize]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape.to_vec()))
}

/// The sums of the columns of `rows`: written to `place` if there is one, and returned otherwise.
pub(super) fn column_sums(rows: &[f32], width: usize, place: Option<&mut [f32]>) -> Option<FlexTensor> {
    let Some(place) = place else {
        let mut sum = vec![0.0; width];
        add_rows(&mut sum, rows);
        return Some(make(sum, &[width]));
    };
    place.fill(0.0);
    add_rows(place, rows);
    None
}

/// A function of every element, whose gradient follows from the input.
#[derive(Debug, Clone)]
pub(super) struct Elementwise {
    /// The function of each element.
    pub(super) forward: fn(&[f32]) -> Vec<f32>,
    /// Multiplies the second slice by the slope at the first.
    pub(super) backward: fn(&[f32], &mut [f32]),
}

impl Fused<1> for Elementwise {
    type Kept = FlexTensor;

    fn forward(&self, [x]: [FlexTensor; 1]) -> (FlexTensor, FlexTensor) {
        (make((self.forward)(slice(&x)), &shape(&x)), x)
    }

    fn backward(&self, x: FlexTensor, dy: FlexTensor, _: [bool; 1]) -> [Option<FlexTensor>; 1] {
        [Some(overwrite(dy, |dy| (self.backward)(slice(&x), dy)))]
    }
}
