//! Initial values of parameters, drawn on the host from a keyed stream in declaration order. A backend's global
//! generator is never used: its state cannot be saved and differs between backends.

use burn::module::{Param, ParamId};
use burn::tensor::{Device, Tensor, TensorData};
use motion::random::Stream;
use protocol::Seed;
use protocol::stage::Positions;

/// Draws initial values of parameters.
#[derive(Debug)]
pub struct Init<'a> {
    stream: Stream,
    device: &'a Device,
    positions: Positions,
    draws: Draws,
}

/// Source of the initial values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Draws {
    /// Values from the keyed stream.
    Made,
    /// Zeros in place of the values from the stream.
    Left,
    /// No values; the parameters stay uninitialised.
    Never,
}

impl<'a> Init<'a> {
    /// Draws all parameters of one network of one stage. `purpose` separates two networks of one stage.
    pub fn new(seed: Seed, purpose: &str, positions: Positions, device: &'a Device) -> Self {
        Self { stream: Stream::new(seed, purpose, 0, 0), device, positions, draws: Draws::Made }
    }

    /// Fills all parameters with zeros, for a network whose weights are loaded next. Draws of a large one take longer.
    pub fn blank(device: &'a Device) -> Self {
        Self { draws: Draws::Left, ..Self::new(Seed(0), "blank", Positions::Uniform, device) }
    }

    /// Makes no values, for reading a network's [layout](crate::flat::layout). A network of any size takes no memory.
    pub fn shapes(device: &'a Device) -> Self {
        Self { draws: Draws::Never, ..Self::blank(device) }
    }

    /// The device of the parameters.
    pub fn device(&self) -> &Device {
        self.device
    }

    fn param<const D: usize>(&self, values: impl FnOnce() -> Vec<f32>, shape: [usize; D]) -> Param<Tensor<D>> {
        if self.draws == Draws::Never {
            let zeros = move |device: &Device, _| Tensor::zeros(shape, device);
            return Param::uninitialized(ParamId::new(), zeros, self.device.clone(), true, shape.into());
        }
        Param::from_tensor(Tensor::from_data(TensorData::new(values(), shape), self.device))
    }

    fn draw<const D: usize>(&mut self, low: f64, high: f64, shape: [usize; D]) -> Param<Tensor<D>> {
        #[expect(clippy::cast_possible_truncation, reason = "parameters are f32")]
        let values = match self.draws {
            Draws::Made => (0..shape.iter().product()).map(|_| self.stream.range(low, high) as f32).collect(),
            Draws::Left => vec![0.0; shape.iter().product()],
            Draws::Never => Vec::new(),
        };
        self.param(|| values, shape)
    }

    /// A parameter whose elements are all `value`.
    pub fn constant<const D: usize>(&self, value: f32, shape: [usize; D]) -> Param<Tensor<D>> {
        self.param(|| vec![value; shape.iter().product()], shape)
    }

    /// Uniform within `±sqrt(6 / (fan_in + fan_out))` of an [out, in] matrix (Glorot and Bengio, 2010).
    #[expect(clippy::cast_precision_loss, reason = "widths are small")]
    pub fn xavier(&mut self, out: usize, inner: usize) -> Param<Tensor<2>> {
        let bound = (6.0 / (inner + out) as f64).sqrt();
        self.draw(-bound, bound, [out, inner])
    }

    /// Normal with deviation `sqrt(2 / (fan_in + fan_out))`, the fans given.
    #[expect(
        clippy::cast_precision_loss,
        clippy::cast_possible_truncation,
        reason = "widths are small, parameters f32"
    )]
    pub fn xavier_normal<const D: usize>(&mut self, fans: usize, shape: [usize; D]) -> Param<Tensor<D>> {
        let deviation = (2.0 / fans as f64).sqrt() as f32;
        self.normal_times(deviation, shape)
    }

    /// Uniform within `±1 / sqrt(fan_in)`: PyTorch's default for a Linear's weight and bias.
    #[expect(clippy::cast_precision_loss, reason = "widths are small")]
    pub fn fan_in<const D: usize>(&mut self, inner: usize, shape: [usize; D]) -> Param<Tensor<D>> {
        let bound = 1.0 / (inner as f64).sqrt();
        self.draw(-bound, bound, shape)
    }

    /// Draws from the standard normal distribution.
    pub fn normal<const D: usize>(&mut self, shape: [usize; D]) -> Param<Tensor<D>> {
        self.normal_times(1.0, shape)
    }

    /// Draws from a normal distribution with this deviation.
    pub fn scaled_normal<const D: usize>(&mut self, deviation: f64, shape: [usize; D]) -> Param<Tensor<D>> {
        self.normal_times(deviation as f32, shape)
    }

    fn normal_times<const D: usize>(&mut self, deviation: f32, shape: [usize; D]) -> Param<Tensor<D>> {
        let mut values = match self.draws {
            Draws::Never => Vec::new(),
            Draws::Made | Draws::Left => vec![0.0; shape.iter().product()],
        };
        if self.draws == Draws::Made {
            self.stream.fill_normal(&mut values);
            values.iter_mut().for_each(|v| *v *= deviation);
        }
        self.param(|| values, shape)
    }

    /// A position table [rows, 1, width]: uniform on [0, 1) as published, or sinusoids.
    pub fn positions(&mut self, rows: usize, width: usize) -> Param<Tensor<3>> {
        match self.positions {
            Positions::Uniform => self.draw(0.0, 1.0, [rows, 1, width]),
            Positions::Sinusoid => {
                #[expect(clippy::cast_precision_loss, clippy::cast_possible_truncation, reason = "small tables of f32")]
                let value = |row: usize, column: usize| {
                    let half = width / 2;
                    let frequency = 10_000_f64.powf(-((column % half.max(1)) as f64) / half.max(1) as f64);
                    let angle = row as f64 * frequency;
                    (if column < half { angle.sin() } else { angle.cos() }) as f32
                };
                let values = || (0..rows).flat_map(|r| (0..width).map(move |c| value(r, c))).collect();
                self.param(values, [rows, 1, width])
            }
        }
    }
}
