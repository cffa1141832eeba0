// Scalars through a piecewise-linear transfer function, cut at its knots: see
// difftetvr/rendering/traversal/transfer.py.

fn knotAt(index: i32) -> f32 {
  return knotsAt(u32(2 * index)).x;
}

fn opticsAt(index: i32) -> vec4f {
  return knotsAt(u32(2 * index + 1));
}

// Last knot below a scalar, or at it where inclusive; -1 where there is none.
fn intervalOf(scalar: f32, inclusive: bool) -> i32 {
  var low: i32 = 0;
  var high: i32 = frame.knotCount;
  while (low < high) {
    let middle: i32 = (low + high) / 2;
    let knot: f32 = knotAt(middle);
    if (knot < scalar || (inclusive && knot == scalar)) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low - 1;
}

fn scalarsAbsorbed(before: Light, depth: f32, f0: f32, f1: f32) -> Light {
  let rises: bool = f1 >= f0;
  let varies: bool = f1 != f0;
  let rise: f32 = select(1.0, f1 - f0, varies);
  var light: Light = before;
  var interval: i32 = intervalOf(f0, !(rises && varies));
  var x: f32 = 0.0;
  var f: f32 = f0;
  for (var piece: i32 = 0; piece <= frame.knotCount; piece++) {
    let ahead: i32 = select(interval, interval + 1, rises);
    let isKnot: bool = varies && ahead >= 0 && ahead < frame.knotCount;
    let knot: f32 = knotAt(clamp(ahead, 0, frame.knotCount - 1));
    let cuts: bool = isKnot && ((rises && knot <= f1) || (!rises && knot >= f1));
    let xEnd: f32 = select(1.0, clamp((knot - f0) / rise, x, 1.0), cuts && knot != f1);
    let fEnd: f32 = select(f1, knot, cuts);
    if (xEnd > x) {
      let lower: i32 = max(interval, 0);
      let upper: i32 = min(interval + 1, frame.knotCount - 1);
      let below: vec4f = opticsAt(lower);
      let above: vec4f = opticsAt(upper);
      let low: f32 = knotAt(lower);
      let width: f32 = knotAt(upper) - low;
      let inverse: f32 = select(0.0, 1.0 / width, width > 0.0);
      let c0: vec4f = mix(below, above, clamp((f - low) * inverse, 0.0, 1.0));
      let c1: vec4f = mix(below, above, clamp((fEnd - low) * inverse, 0.0, 1.0));
      light = absorbed(light, depth * (xEnd - x), c0, c1);
    }
    if (!cuts) {
      break;
    }
    interval += select(-1, 1, rises);
    x = xEnd;
    f = fEnd;
  }
  return light;
}
