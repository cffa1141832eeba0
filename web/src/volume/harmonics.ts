// Colours that depend on the direction they are seen from, as in difftetvr/mesh/harmonics.py.
import type { Vector } from "./payload";

function basisOf(x: number, y: number, z: number, degree: number): number[] {
  const basis = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x];
  if (degree < 2) return basis;
  const [xx, yy, zz] = [x * x, y * y, z * z];
  basis.push(
    1.0925484305920792 * x * y,
    -1.0925484305920792 * y * z,
    0.31539156525252005 * (2 * zz - xx - yy),
    -1.0925484305920792 * x * z,
    0.5462742152960396 * (xx - yy),
  );
  if (degree < 3) return basis;
  basis.push(
    -0.5900435899266435 * y * (3 * xx - yy),
    2.890611442640554 * x * y * z,
    -0.4570457994644658 * y * (4 * zz - xx - yy),
    0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
    -0.4570457994644658 * x * (4 * zz - xx - yy),
    1.445305721320277 * z * (xx - yy),
    -0.5900435899266435 * x * (xx - 3 * yy),
  );
  return basis;
}

/** Writes the colours that a camera sees.
 *
 * @param seen (N, 4), of which the first three are written.
 * @param values (N, 4) with the colours that are the same from all sides.
 * @param places (N, 3).
 * @param coefficients (N, 3 B).
 */
export function seenFrom(
  seen: Float32Array,
  values: Float32Array,
  places: Float32Array,
  coefficients: Float32Array,
  degree: number,
  eye: Vector,
): void {
  const count = places.length / 3;
  const width = coefficients.length / count;
  for (let i = 0; i < count; i++) {
    const x = places[3 * i] - eye[0];
    const y = places[3 * i + 1] - eye[1];
    const z = places[3 * i + 2] - eye[2];
    const inverse = 1 / (Math.hypot(x, y, z) || 1);
    const basis = basisOf(x * inverse, y * inverse, z * inverse, degree);
    let [r, g, b] = [values[4 * i], values[4 * i + 1], values[4 * i + 2]];
    for (let k = 0, at = i * width; k < basis.length; k++, at += 3) {
      r += basis[k] * coefficients[at];
      g += basis[k] * coefficients[at + 1];
      b += basis[k] * coefficients[at + 2];
    }
    seen[4 * i] = Math.max(r, 0);
    seen[4 * i + 1] = Math.max(g, 0);
    seen[4 * i + 2] = Math.max(b, 0);
  }
}
