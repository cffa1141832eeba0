// Linear density and linear colour along a crossing, integrated exactly: see difftetvr/optics/special.py, of which
// this is the float32 version; its constants come with the page (see constants.ts).

// (w0, w1, T1) of a crossing whose optical depth would be first at its first density, last at its last.
fn weightsOf(first: f32, last: f32) -> vec3f {
  let a: f32 = min(first, 1e18);
  let b: f32 = min(last, 1e18);
  let tau: f32 = 0.5 * (a + b);
  let v: f32 = 0.5 * (b - a);
  if (tau > THIN) {
    let root: f32 = sqrt(max(a * a + 4.0 * VISIBLE * v, 0.0));
    let reach: f32 = select(1.0, 2.0 * VISIBLE / (a + root), tau > VISIBLE);
    let m0: f32 = reach * quadrature(-a * reach, -v * reach * reach);
    let transmittance: f32 = exp(-tau);
    return vec3f(1.0 - m0, m0 - transmittance, transmittance);
  }
  let square: f32 = tau * tau;
  let h: f32 = hOf(tau);
  let sine: f32 = tau * sinhOf(square);
  let q: f32 = square * pOf(square) - 2.0 * v * uOf(square, v);
  return vec3f(h * (sine + q), h * (sine - q), 1.0 - 2.0 * h * sine);
}

struct Light {
  color: vec3f,
  transmittance: f32,
}

// What is left and added behind a piece; c0 and c1 are linear RGB and density at its ends.
fn absorbed(light: Light, depth: f32, c0: vec4f, c1: vec4f) -> Light {
  let a: f32 = depth * c0.w;
  let b: f32 = depth * c1.w;
  if (!(a + b > 0.0)) {
    return light;
  }
  let w: vec3f = weightsOf(a, b);
  return Light(light.color + light.transmittance * (w.x * c0.xyz + w.y * c1.xyz), light.transmittance * w.z);
}
