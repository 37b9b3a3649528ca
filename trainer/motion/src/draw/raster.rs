//! Anti-aliased lines and discs on an RGB canvas, and the palette of a GIF.

/// Red, green and blue, 0 to 255.
pub(super) type Colour = [u8; 3];

/// Mixes `share` of `over` with the rest of `under`.
pub(super) fn blend(under: Colour, over: Colour, share: f64) -> Colour {
    std::array::from_fn(|k| (f64::from(under[k]) + (f64::from(over[k]) - f64::from(under[k])) * share).round() as u8)
}

pub(super) struct Canvas {
    pub(super) width: usize,
    height: usize,
    pixels: Vec<Colour>,
}

impl Canvas {
    pub(super) fn new(width: usize, height: usize, paper: Colour) -> Self {
        Self { width, height, pixels: vec![paper; width * height] }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.pixels.as_flattened()
    }

    /// Draws a line with round ends; the coverage of a pixel depends on the distance of its middle from the edge.
    pub(super) fn line(&mut self, a: [f64; 2], b: [f64; 2], width: f64, colour: Colour) {
        let radius = 0.5 * width;
        let bounds = |k: usize, limit: usize| {
            let low = (a[k].min(b[k]) - radius - 1.0).floor().clamp(0.0, limit as f64) as usize;
            let high = (a[k].max(b[k]) + radius + 2.0).ceil().clamp(0.0, limit as f64) as usize;
            low..high
        };
        let along = [b[0] - a[0], b[1] - a[1]];
        let length = (along[0] * along[0] + along[1] * along[1]).max(1e-9);
        for y in bounds(1, self.height) {
            for x in bounds(0, self.width) {
                let p = [x as f64 + 0.5 - a[0], y as f64 + 0.5 - a[1]];
                let share = ((p[0] * along[0] + p[1] * along[1]) / length).clamp(0.0, 1.0);
                let distance = (p[0] - share * along[0]).hypot(p[1] - share * along[1]);
                let cover = (radius + 0.5 - distance).clamp(0.0, 1.0) * width.min(1.0);
                if cover > 0.0 {
                    let pixel = &mut self.pixels[y * self.width + x];
                    *pixel = blend(*pixel, colour, cover);
                }
            }
        }
    }

    pub(super) fn disc(&mut self, at: [f64; 2], radius: f64, colour: Colour) {
        self.line(at, at, 2.0 * radius, colour);
    }

    /// A filled square of `size` pixels.
    pub(super) fn dot(&mut self, x: i64, y: i64, size: i64, colour: Colour) {
        for (dx, dy) in (0..size).flat_map(|dy| (0..size).map(move |dx| (dx, dy))) {
            let (x, y) = (x + dx, y + dy);
            if (0..self.width as i64).contains(&x) && (0..self.height as i64).contains(&y) {
                self.pixels[y as usize * self.width + x as usize] = colour;
            }
        }
    }
}

/// A fixed palette: every mixture of two of the given colours in a few steps, for anti-aliased edges.
pub(super) struct Palette {
    pub(super) bytes: Vec<u8>,
    /// Nearest entry by colour, 5 bits per channel.
    nearest: Vec<u8>,
}

pub(super) fn palette(colours: &[Colour]) -> Palette {
    let mut entries: Vec<Colour> = vec![];
    let mut add = |c: Colour| {
        if entries.len() < 256 && !entries.contains(&c) {
            entries.push(c);
        }
    };
    colours.iter().for_each(|c| add(*c));
    for (i, a) in colours.iter().enumerate() {
        for b in &colours[i + 1..] {
            (1..8).for_each(|k| add(blend(*a, *b, f64::from(k) / 8.0)));
        }
    }
    let nearest = (0..1_usize << 15)
        .map(|key| {
            let c = [key >> 10, (key >> 5) & 31, key & 31].map(|v| (v * 8 + 4) as i32);
            let distance = |e: &Colour| (0..3).map(|k| (i32::from(e[k]) - c[k]).pow(2)).sum::<i32>();
            (0..entries.len()).min_by_key(|i| distance(&entries[*i])).unwrap_or(0) as u8
        })
        .collect();
    Palette { bytes: entries.into_flattened(), nearest }
}

impl Palette {
    pub(super) fn indices(&self, canvas: &Canvas) -> Vec<u8> {
        let key = |c: &Colour| usize::from(c[0] >> 3) << 10 | usize::from(c[1] >> 3) << 5 | usize::from(c[2] >> 3);
        canvas.pixels.iter().map(|c| self.nearest[key(c)]).collect()
    }
}
