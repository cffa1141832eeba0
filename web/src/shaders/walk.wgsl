// A ray's way through the mesh, from cell to cell: see difftetvr/rendering/traversal/walk.py for the method.
//
// Which face a ray leaves through is decided by signs of edge functions, which all cells around an edge must see alike.
// There is no fused multiply-add here to make floats exact, and a compiler may use one where it pleases; so offsets
// from the ray are whole numbers of at most 24 bits, and where a float leaves the sign open, integers decide.

const NONE: u32 = 0xffffffffu;
const INFINITE: f32 = 1e30;
const STEPS_PER_UNIT: f32 = 4194304.0;  // offsets are less than 2, so whole numbers below 2^23
const OPAQUE: f32 = 5e-4;
// Of what is counted of a ray: its steps, whether it lost its way, whether it ran out of steps.
const STEPS: u32 = 0xffffffu;
const LOST: u32 = 0x1000000u;
const BOUNDED: u32 = 0x2000000u;

struct Ray {
  origin: vec3f,
  a: vec3f,
  b: vec3f,
  direction: vec3f,
}

struct Corner {
  vertex: u32,
  offset: vec2f,  // whole numbers
  t: f32,
  value: vec4f,
}

// Through a place in the picture, in pixels from its upper left corner.
fn rayThrough(place: vec2f) -> Ray {
  let inLens: vec2f = (place - frame.lens.zw) / frame.lens.xy;
  let d: vec3f = normalize(inLens.x * frame.right.xyz + inLens.y * frame.down.xyz + frame.forward.xyz);
  // Near the mesh, so that nothing is lost where the eye is far away.
  let origin: vec3f = frame.eye.xyz - dot(frame.eye.xyz, d) * d;
  let s: f32 = select(-1.0, 1.0, d.z >= 0.0);
  let inverse: f32 = -1.0 / (s + d.z);
  let xy: f32 = d.x * d.y * inverse;
  let a: vec3f = vec3f(1.0 + s * d.x * d.x * inverse, s * xy, -s * d.x);
  let b: vec3f = vec3f(xy, s + d.y * d.y * inverse, -d.y);
  return Ray(origin, a, b, d);
}

fn cornerAt(ray: Ray, vertex: u32) -> Corner {
  let record: vec4f = verticesAt(vertex);
  let away: vec3f = record.xyz - ray.origin;
  let offset: vec2f = floor(vec2f(dot(ray.a, away), dot(ray.b, away)) * STEPS_PER_UNIT + 0.5);
  var color: vec3f = vec3f(0.0);
  if (VERTEX_COLORS) {
    color = colorsAt(vertex).xyz;
  }
  return Corner(vertex, offset, dot(ray.direction, away), vec4f(color, record.w));
}

fn exactEdge(p: vec2i, q: vec2i) -> f32 {
  let pHigh: vec2i = p >> vec2u(12u);
  let qHigh: vec2i = q >> vec2u(12u);
  let pLow: vec2i = p & vec2i(4095);
  let qLow: vec2i = q & vec2i(4095);
  let low: i32 = pLow.x * qLow.y - pLow.y * qLow.x;
  let middle: i32 = pHigh.x * qLow.y + pLow.x * qHigh.y - pHigh.y * qLow.x - pLow.y * qHigh.x + (low >> 12u);
  let high: i32 = pHigh.x * qHigh.y - pHigh.y * qHigh.x + (middle >> 12u);
  return f32(high) * 16777216.0 + f32((middle & 4095) * 4096 + (low & 4095));
}

// Twice the signed area of (ray, p, q), of which the sign is exact.
fn edgeOf(p: vec2f, q: vec2f) -> f32 {
  let x: f32 = p.x * q.y;
  let y: f32 = p.y * q.x;
  let edge: f32 = x - y;
  if (abs(edge) > (abs(x) + abs(y)) * 2.4e-7) {
    return edge;
  }
  return exactEdge(vec2i(p), vec2i(q));
}

// Ties are broken as if the ray were shifted by (eps, eps^2), and two vertices at one place by their numbers.
fn isLeft(edge: f32, p: Corner, q: Corner) -> bool {
  if (edge != 0.0) {
    return edge > 0.0;
  }
  if (p.offset.y != q.offset.y) {
    return p.offset.y > q.offset.y;
  }
  if (p.offset.x != q.offset.x) {
    return q.offset.x > p.offset.x;
  }
  return p.vertex < q.vertex;
}

struct Face {
  p: Corner,
  q: Corner,
  r: Corner,
  edges: vec3f,  // opposite p, q, r
}

fn faceOf(p: Corner, q: Corner, r: Corner) -> Face {
  return Face(p, q, r, vec3f(edgeOf(q.offset, r.offset), edgeOf(r.offset, p.offset), edgeOf(p.offset, q.offset)));
}

fn holdsRay(face: Face) -> bool {
  return isLeft(face.edges.x, face.q, face.r) && isLeft(face.edges.y, face.r, face.p) &&
         isLeft(face.edges.z, face.p, face.q);
}

fn weightsOn(face: Face) -> vec3f {
  let sum: f32 = face.edges.x + face.edges.y + face.edges.z;
  if (sum > 0.0) {
    return max(face.edges, vec3f(0.0)) / sum;
  }
  return vec3f(1.0, 0.0, 0.0);
}

fn distanceTo(face: Face) -> f32 {
  return dot(weightsOn(face), vec3f(face.p.t, face.q.t, face.r.t));
}

fn valueOn(face: Face) -> vec4f {
  let w: vec3f = weightsOn(face);
  return w.x * face.p.value + w.y * face.q.value + w.z * face.r.value;
}

fn boundaryFace(ray: Ray, index: i32) -> Face {
  let record: vec4u = facesAt(u32(2 * index));
  return faceOf(cornerAt(ray, record.x), cornerAt(ray, record.y), cornerAt(ray, record.z));
}

fn nonZero(x: f32) -> f32 {
  return select(x, 1e-12, abs(x) < 1e-12);
}

// A boundary face through which a ray enters; -1: none.
struct Entry {
  face: i32,
  t: f32,
}

// The next one after another.
fn nextEntry(ray: Ray, before: Entry) -> Entry {
  let inverse: vec3f = 1.0 / vec3f(nonZero(ray.direction.x), nonZero(ray.direction.y), nonZero(ray.direction.z));
  var found: Entry = Entry(-1, INFINITE);
  var node: i32 = 0;
  while (node < frame.nodeCount) {
    let lower: vec4f = nodesAt(u32(2 * node));
    let upper: vec4f = nodesAt(u32(2 * node + 1));
    let x: vec3f = (lower.xyz - ray.origin) * inverse;
    let y: vec3f = (upper.xyz - ray.origin) * inverse;
    let low: vec3f = min(x, y);
    let high: vec3f = max(x, y);
    let first: f32 = max(max(low.x, low.y), low.z);
    let end: f32 = min(min(high.x, high.y), high.z);
    // Distances to boxes and to faces are rounded differently.
    let meets: bool = first <= end && end >= before.t - 1e-5 && first <= found.t + 1e-5;
    if (meets && upper.w >= 0.0) {
      let begin: i32 = i32(upper.w) / 8;
      let count: i32 = i32(upper.w) & 7;
      for (var index: i32 = begin; index < begin + count; index++) {
        let face: Face = boundaryFace(ray, index);
        if (holdsRay(face)) {
          let t: f32 = distanceTo(face);
          let isAhead: bool = t > before.t || (t == before.t && index > before.face);
          if (isAhead && (t < found.t || (t == found.t && index < found.face))) {
            found = Entry(index, t);
          }
        }
      }
    }
    node = select(i32(lower.w), node + 1, meets);
  }
  return found;
}

struct Span {
  near: f32,
  far: f32,
}

// What of the ray is looked at: what lies before the eye, on the right side of the plane.
fn spanOf(ray: Ray) -> Span {
  let eye: f32 = dot(frame.eye.xyz - ray.origin, ray.direction);
  let slope: f32 = dot(frame.clip.xyz, ray.direction);
  let at: f32 = dot(frame.clip.xyz, ray.origin) + frame.clip.w;
  if (slope > 0.0) {
    return Span(max(eye, -at / slope), INFINITE);
  }
  if (slope < 0.0) {
    return Span(eye, -at / slope);
  }
  return Span(eye, select(INFINITE, -INFINITE, at < 0.0));
}

// Behind the part of a crossing that lies in the span.
fn crossed(light: Light, span: Span, t0: f32, v0: vec4f, t1: f32, v1: vec4f) -> Light {
  let first: f32 = max(t0, span.near);
  let end: f32 = min(t1, span.far);
  if (!(end > first)) {
    return light;
  }
  let slope: vec4f = (v1 - v0) / (t1 - t0);
  var c0: vec4f = v0;
  var c1: vec4f = v1;
  if (first > t0) {
    c0 = v0 + (first - t0) * slope;
  }
  if (end < t1) {
    c1 = v0 + (end - t0) * slope;
  }
  if (SCALARS) {
    return scalarsAbsorbed(light, (end - first) * frame.density, c0.w, c1.w);
  }
  return absorbed(light, (end - first) * frame.density, c0, c1);
}

struct Traced {
  light: Light,
  record: u32,   // see STEPS
  isOver: bool,  // whether nothing is to be seen any further
}

// From an entry to the boundary.
fn walked(ray: Ray, span: Span, entry: i32, before: Traced) -> Traced {
  var face: Face = boundaryFace(ray, entry);
  var apex: u32 = facesAt(u32(2 * entry)).w;
  var cell: u32 = facesAt(u32(2 * entry + 1)).x;
  var t0: f32 = distanceTo(face);
  var v0: vec4f = valueOn(face);
  var light: Light = before.light;
  var record: u32 = before.record;
  while ((record & STEPS) < u32(frame.mostSteps)) {
    let c: Corner = cornerAt(ray, apex);
    let to: vec3f =
        vec3f(edgeOf(face.p.offset, c.offset), edgeOf(face.q.offset, c.offset), edgeOf(face.r.offset, c.offset));
    let leftP: bool = isLeft(to.x, face.p, c);
    let leftQ: bool = isLeft(to.y, face.q, c);
    let leftR: bool = isLeft(to.z, face.r, c);
    // The apex takes the place of one corner: of the one that lies between a left and a right edge.
    var dropsP: bool = leftR && !leftQ;
    var dropsQ: bool = leftP && !leftR;
    if (!dropsP && !dropsQ && !(leftQ && !leftP)) {
      // A compiler has rounded one vertex in two ways, and the ray runs next to it: then to what is least wrong.
      record = record | LOST;
      let wrong: vec3f = max(-to.zxy, to.yzx);
      dropsP = wrong.x <= min(wrong.y, wrong.z);
      dropsQ = !dropsP && wrong.y <= wrong.z;
    }
    var dropped: u32 = face.r.vertex;
    if (dropsP) {
      dropped = face.p.vertex;
      face.edges = vec3f(face.edges.x, to.z, -to.y);
      face.p = c;
    } else if (dropsQ) {
      dropped = face.q.vertex;
      face.edges = vec3f(-to.z, face.edges.y, to.x);
      face.q = c;
    } else {
      face.edges = vec3f(to.y, -to.x, face.edges.z);
      face.r = c;
    }
    let t1: f32 = distanceTo(face);
    var v1: vec4f = vec4f(0.0);
    if (CELLS) {
      v1 = colorsAt(cell);
      v0 = v1;
    } else {
      v1 = valueOn(face);
    }
    light = crossed(light, span, t0, v0, t1, v1);
    if (light.transmittance <= OPAQUE || t1 >= span.far) {
      return Traced(light, record, true);
    }
    record++;
    // Rows of a cell are in the order of its vertices.
    let rank: u32 = u32(face.p.vertex < dropped) + u32(face.q.vertex < dropped) + u32(face.r.vertex < dropped);
    let behind: vec2u = linksAt(4u * cell + rank);
    if (behind.x == NONE) {
      return Traced(light, record, false);
    }
    cell = behind.x;
    apex = behind.y;
    t0 = t1;
    v0 = v1;
  }
  return Traced(light, record | BOUNDED, true);
}

// What is seen through a place in the picture, and how the ray fared.
fn traced(place: vec2f) -> Traced {
  let ray: Ray = rayThrough(place);
  var ends: Traced = Traced(Light(vec3f(0.0), 1.0), 0u, false);
  // The mesh lies in a ball around the origin.
  if (dot(ray.origin, ray.origin) < 0.76) {
    let span: Span = spanOf(ray);
    var entry: Entry = Entry(-1, -INFINITE);
    while (!ends.isOver) {
      entry = nextEntry(ray, entry);
      if (entry.face < 0 || entry.t >= span.far) {
        break;
      }
      ends = walked(ray, span, entry.face, ends);
    }
  }
  return ends;
}
