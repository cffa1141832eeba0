// Scalars through a piecewise-linear transfer function, cut at its knots: see
// difftetvr/rendering/traversal/transfer.py.

uniform sampler2D knots;  // (K, 2): scalar; linear RGB and opacity
uniform int knotCount;

float knotAt(int index) { return texelFetch(knots, ivec2(index, 0), 0).r; }

// Last knot below a scalar, or at it where inclusive; -1 where there is none.
int intervalOf(float scalar, bool inclusive) {
  int low = 0, high = knotCount;
  while (low < high) {
    int middle = (low + high) >> 1;
    float knot = knotAt(middle);
    if (knot < scalar || (inclusive && knot == scalar)) low = middle + 1; else high = middle;
  }
  return low - 1;
}

void absorbScalars(inout Light light, float depth, float f0, float f1) {
  bool rises = f1 >= f0, varies = f1 != f0;
  int interval = intervalOf(f0, !(rises && varies));
  float x = 0.0, f = f0, rise = varies ? f1 - f0 : 1.0;
  for (int piece = 0; piece <= knotCount; piece++) {
    int ahead = rises ? interval + 1 : interval;
    bool cuts = varies && ahead >= 0 && ahead < knotCount;
    float knot = cuts ? knotAt(ahead) : 0.0;
    cuts = cuts && (rises ? knot <= f1 : knot >= f1);
    float xEnd = cuts && knot != f1 ? clamp((knot - f0) / rise, x, 1.0) : 1.0;
    float fEnd = cuts ? knot : f1;
    if (xEnd > x) {
      int lower = max(interval, 0), upper = min(interval + 1, knotCount - 1);
      vec4 below = texelFetch(knots, ivec2(lower, 1), 0), above = texelFetch(knots, ivec2(upper, 1), 0);
      float low = knotAt(lower), width = knotAt(upper) - low;
      float inverse = width > 0.0 ? 1.0 / width : 0.0;
      vec4 c0 = mix(below, above, clamp((f - low) * inverse, 0.0, 1.0));
      vec4 c1 = mix(below, above, clamp((fEnd - low) * inverse, 0.0, 1.0));
      absorb(light, depth * (xEnd - x), c0, c1);
    }
    if (!cuts) return;
    interval += rises ? 1 : -1;
    x = xEnd;
    f = fEnd;
  }
}
