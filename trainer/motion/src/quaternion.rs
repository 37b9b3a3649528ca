//! Quaternions `(w, x, y, z)` and 6D rotations, in f64.
//!
//! Conventions of the HumanML3D feature definition: Hamilton product, conjugate as inverse, and a 6D rotation is the
//! first column of the matrix, then the second. The published code computes in f32; results differ only by rounding.

/// A quaternion `(w, x, y, z)`.
pub type Quat = [f64; 4];

/// A vector `(x, y, z)`.
pub type Vec3 = [f64; 3];

/// The identity rotation, `(1, 0, 0, 0)`.
pub const IDENTITY: Quat = [1.0, 0.0, 0.0, 0.0];

/// Sum of two vectors.
pub fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// Difference of two vectors.
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// A vector times a number.
pub fn scale(a: Vec3, s: f64) -> Vec3 {
    a.map(|v| v * s)
}

/// Scalar product of two vectors.
pub fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Vector product `a x b`.
pub fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Euclidean length of a vector.
pub fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// The direction of a vector; NaN for the zero vector.
pub fn unit(a: Vec3) -> Vec3 {
    scale(a, 1.0 / norm(a))
}

/// Hamilton product: applies `b`, then `a`.
pub fn mul(a: Quat, b: Quat) -> Quat {
    [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]
}

/// The conjugate, which is the inverse of a unit quaternion.
pub fn inverse(q: Quat) -> Quat {
    [q[0], -q[1], -q[2], -q[3]]
}

/// Rotates `v` by `q`.
pub fn rotate(q: Quat, v: Vec3) -> Vec3 {
    let u = [q[1], q[2], q[3]];
    let once = cross(u, v);
    let twice = cross(u, once);
    [0, 1, 2].map(|k| v[k] + 2.0 * (q[0] * once[k] + twice[k]))
}

/// The shortest rotation from the direction of `a` to that of `b`. Undefined (NaN) for opposite directions.
pub fn between(a: Vec3, b: Vec3) -> Quat {
    let axis = cross(a, b);
    normalise([(dot(a, a) * dot(b, b)).sqrt() + dot(a, b), axis[0], axis[1], axis[2]])
}

/// Scales to a unit quaternion of the same direction.
pub fn normalise(q: Quat) -> Quat {
    let length = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    q.map(|v| v / length)
}

/// The rotation by `angle` radians about an axis of unit length.
pub fn about(axis: Vec3, angle: f64) -> Quat {
    let (sin, cos) = (0.5 * angle).sin_cos();
    [cos, axis[0] * sin, axis[1] * sin, axis[2] * sin]
}

/// Rows of the rotation matrix.
pub fn to_matrix(q: Quat) -> [Vec3; 3] {
    let [w, x, y, z] = q;
    let s = 2.0 / q.iter().map(|v| v * v).sum::<f64>();
    [
        [1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)],
    ]
}

/// First and second column of the rotation matrix.
pub fn to_6d(q: Quat) -> [f64; 6] {
    let m = to_matrix(q);
    [m[0][0], m[1][0], m[2][0], m[0][1], m[1][1], m[2][1]]
}

/// Rows of the matrix of six numbers, which need not be orthonormal: the first column keeps its direction, the second
/// is made perpendicular to it.
pub fn matrix_from_6d(c: [f64; 6]) -> [Vec3; 3] {
    let x = unit([c[0], c[1], c[2]]);
    let z = unit(cross(x, [c[3], c[4], c[5]]));
    let y = cross(z, x);
    [0, 1, 2].map(|k| [x[k], y[k], z[k]])
}

/// Product of two matrices, given as rows.
pub fn matmul(a: [Vec3; 3], b: [Vec3; 3]) -> [Vec3; 3] {
    a.map(|row| [0, 1, 2].map(|k| row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k]))
}

/// Product of a matrix and a vector.
pub fn apply(m: [Vec3; 3], v: Vec3) -> Vec3 {
    m.map(|row| dot(row, v))
}
