// Linear density and linear colour along a crossing, integrated exactly: see difftetvr/optics/special.py, of which
// this is the float32 version; its constants come with the page.

// (w0, w1, T1) of a crossing whose optical depth would be a at its first density, b at its last.
vec3 weightsOf(float a, float b) {
  a = min(a, 1e18);
  b = min(b, 1e18);
  float tau = 0.5 * (a + b), v = 0.5 * (b - a);
  if (tau > THIN) {
    bool hidden = tau > VISIBLE;
    float root = sqrt(max(a * a + 4.0 * VISIBLE * v, 0.0));
    float reach = hidden ? 2.0 * VISIBLE / (a + root) : 1.0;
    float slope = -a * reach, curve = -v * reach * reach, m0 = 0.0;
    for (int i = 0; i < NODE_COUNT; i++) m0 += WEIGHTS[i] * exp((curve * NODES[i] + slope) * NODES[i]);
    m0 *= reach;
    float transmittance = exp(-tau);
    return vec3(1.0 - m0, m0 - transmittance, transmittance);
  }
  float square = tau * tau;
  float h = H_OF(tau);
  float sine = tau * SINH_OF(square);
  float q = square * P_OF(square) - 2.0 * v * U_OF(square, v);
  return vec3(h * (sine + q), h * (sine - q), 1.0 - 2.0 * h * sine);
}

struct Light {
  vec3 color;
  float transmittance;
};

// What a piece adds; c0 and c1 are linear RGB and density at its ends.
void absorb(inout Light light, float depth, vec4 c0, vec4 c1) {
  float a = depth * c0.w, b = depth * c1.w;
  if (!(a + b > 0.0)) return;
  vec3 w = weightsOf(a, b);
  light.color += light.transmittance * (w.x * c0.rgb + w.y * c1.rgb);
  light.transmittance *= w.z;
}
