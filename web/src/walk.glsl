// A ray's way through the mesh, from cell to cell: see difftetvr/rendering/traversal/walk.py for the method.
//
// Which face a ray leaves through is decided by signs of edge functions, which all cells around an edge must see alike.
// There is no fused multiply-add here to make floats exact, and a compiler may use one where it pleases; so offsets
// from the ray are whole numbers of at most 24 bits, and where a float leaves the sign open, integers decide.

precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform sampler2D vertices;  // positions, and density or scalar where these are the vertices'
uniform sampler2D colors;    // linear RGB, with density or scalar in w
uniform usampler2D links;    // 4 cell + rank: the cell behind that face, and its apex
uniform usampler2D faces;    // boundary faces in the order of the hierarchy
uniform sampler2D nodes;     // the hierarchy
uniform int nodeCount;
uniform vec3 eye;
uniform mat3 axes;           // columns: right, down, forward
uniform vec4 lens;           // fx, fy, cx, cy in pixels
uniform float height;
uniform vec4 clip;           // half-space that is seen; all zero: everything
uniform vec3 background;
uniform float densityScale;
uniform int mostSteps;

layout(location = 0) out vec4 pixel;
layout(location = 1) out uint audit;  // steps; bit 24: the ray lost its way; bit 25: it ran out of steps

const uint NONE = 0xffffffffu;
const float INFINITE = 1e30;
const float STEPS_PER_UNIT = 4194304.0;  // offsets are less than 2, so whole numbers below 2^23
const float OPAQUE = 5e-4;

ivec2 place(uint index) { return ivec2(int(index & WIDTH_MASK), int(index >> WIDTH_BITS)); }

struct Ray {
  vec3 origin;
  vec3 a;
  vec3 b;
  vec3 direction;
};

struct Corner {
  uint vertex;
  vec2 offset;  // whole numbers
  float t;
  vec4 value;
};

Ray rayThrough(vec2 position) {
  Ray ray;
  ray.direction = normalize(axes * vec3((position - lens.zw) / lens.xy, 1.0));
  // Near the mesh, so that nothing is lost where the eye is far away.
  ray.origin = eye - dot(eye, ray.direction) * ray.direction;
  vec3 d = ray.direction;
  float s = d.z >= 0.0 ? 1.0 : -1.0, inverse = -1.0 / (s + d.z), xy = d.x * d.y * inverse;
  ray.a = vec3(1.0 + s * d.x * d.x * inverse, s * xy, -s * d.x);
  ray.b = vec3(xy, s + d.y * d.y * inverse, -d.y);
  return ray;
}

Corner cornerAt(Ray ray, uint vertex) {
  vec4 record = texelFetch(vertices, place(vertex), 0);
  vec3 from = record.xyz - ray.origin;
  vec2 offset = floor(vec2(dot(ray.a, from), dot(ray.b, from)) * STEPS_PER_UNIT + 0.5);
  vec4 value = vec4(0.0, 0.0, 0.0, record.w);
#ifdef VERTEX_COLORS
  value.rgb = texelFetch(colors, place(vertex), 0).rgb;
#endif
  return Corner(vertex, offset, dot(ray.direction, from), value);
}

float exactEdge(ivec2 p, ivec2 q) {
  ivec2 pHigh = p >> 12, qHigh = q >> 12, pLow = p & 4095, qLow = q & 4095;
  int high = pHigh.x * qHigh.y - pHigh.y * qHigh.x;
  int middle = pHigh.x * qLow.y + pLow.x * qHigh.y - pHigh.y * qLow.x - pLow.y * qHigh.x;
  int low = pLow.x * qLow.y - pLow.y * qLow.x;
  middle += low >> 12;
  high += middle >> 12;
  return float(high) * 16777216.0 + float((middle & 4095) * 4096 + (low & 4095));
}

// Twice the signed area of (ray, p, q), of which the sign is exact.
float edgeOf(vec2 p, vec2 q) {
  float x = p.x * q.y, y = p.y * q.x, edge = x - y;
  if (abs(edge) > (abs(x) + abs(y)) * 2.4e-7) return edge;
  return exactEdge(ivec2(p), ivec2(q));
}

// Ties are broken as if the ray were shifted by (eps, eps^2), and two vertices at one place by their numbers.
bool isLeft(float edge, Corner p, Corner q) {
  if (edge != 0.0) return edge > 0.0;
  if (p.offset.y != q.offset.y) return p.offset.y > q.offset.y;
  if (p.offset.x != q.offset.x) return q.offset.x > p.offset.x;
  return p.vertex < q.vertex;
}

struct Face {
  Corner p;
  Corner q;
  Corner r;
  vec3 edges;  // opposite p, q, r
};

Face faceOf(Corner p, Corner q, Corner r) {
  return Face(p, q, r, vec3(edgeOf(q.offset, r.offset), edgeOf(r.offset, p.offset), edgeOf(p.offset, q.offset)));
}

bool holdsRay(Face face) {
  return isLeft(face.edges.x, face.q, face.r) && isLeft(face.edges.y, face.r, face.p) &&
         isLeft(face.edges.z, face.p, face.q);
}

vec3 weightsOn(Face face) {
  float sum = face.edges.x + face.edges.y + face.edges.z;
  return sum > 0.0 ? max(face.edges, 0.0) / sum : vec3(1.0, 0.0, 0.0);
}

float distanceTo(Face face) {
  vec3 w = weightsOn(face);
  return w.x * face.p.t + w.y * face.q.t + w.z * face.r.t;
}

Face boundaryFace(Ray ray, int index) {
  uvec4 record = texelFetch(faces, place(uint(2 * index)), 0);
  return faceOf(cornerAt(ray, record.x), cornerAt(ray, record.y), cornerAt(ray, record.z));
}

// The next boundary face through which the ray enters, after that at (reached, last); -1: none.
int nextEntry(Ray ray, inout float reached, int last) {
  vec3 d = ray.direction;
  d = mix(d, vec3(1e-12), lessThan(abs(d), vec3(1e-12)));
  vec3 inverse = 1.0 / d;
  int found = -1;
  float nearest = INFINITE;
  for (int node = 0; node < nodeCount;) {
    vec4 lower = texelFetch(nodes, place(uint(2 * node)), 0), upper = texelFetch(nodes, place(uint(2 * node + 1)), 0);
    vec3 x = (lower.xyz - ray.origin) * inverse, y = (upper.xyz - ray.origin) * inverse;
    vec3 low = min(x, y), high = max(x, y);
    float first = max(max(low.x, low.y), low.z), end = min(min(high.x, high.y), high.z);
    // Distances to boxes and to faces are rounded differently.
    bool meets = first <= end && end >= reached - 1e-5 && first <= nearest + 1e-5;
    if (meets && upper.w >= 0.0) {
      int begin = int(upper.w) >> 3, count = int(upper.w) & 7;
      for (int index = begin; index < begin + count; index++) {
        Face face = boundaryFace(ray, index);
        if (!holdsRay(face)) continue;
        float t = distanceTo(face);
        bool isAhead = t > reached || (t == reached && index > last);
        if (isAhead && (t < nearest || (t == nearest && index < found))) {
          nearest = t;
          found = index;
        }
      }
    }
    node = meets ? node + 1 : int(lower.w);
  }
  reached = nearest;
  return found;
}

struct Span {
  float near;
  float far;
};

// What of the ray is looked at: what lies before the eye, on the right side of the plane.
Span spanOf(Ray ray) {
  Span span = Span(dot(eye - ray.origin, ray.direction), INFINITE);
  float slope = dot(clip.xyz, ray.direction), at = dot(clip.xyz, ray.origin) + clip.w;
  if (slope > 0.0) span.near = max(span.near, -at / slope);
  else if (slope < 0.0) span.far = -at / slope;
  else if (at < 0.0) span.far = -INFINITE;
  return span;
}

// The part of a crossing that lies in the span.
void absorbCrossing(inout Light light, Span span, float t0, vec4 v0, float t1, vec4 v1) {
  float first = max(t0, span.near), end = min(t1, span.far);
  if (!(end > first)) return;
  vec4 slope = (v1 - v0) / (t1 - t0);
  vec4 c1 = end < t1 ? v0 + (end - t0) * slope : v1;
  vec4 c0 = first > t0 ? v0 + (first - t0) * slope : v0;
#ifdef SCALARS
  absorbScalars(light, (end - first) * densityScale, c0.w, c1.w);
#else
  absorb(light, (end - first) * densityScale, c0, c1);
#endif
}

vec4 interpolated(Face face) {
  vec3 w = weightsOn(face);
  return w.x * face.p.value + w.y * face.q.value + w.z * face.r.value;
}

// From an entry to the boundary; whether the ray goes on behind it.
bool walk(Ray ray, Span span, int entry, inout Light light, inout uint steps) {
  Face face = boundaryFace(ray, entry);
  uint apex = texelFetch(faces, place(uint(2 * entry)), 0).w;
  uint cell = texelFetch(faces, place(uint(2 * entry + 1)), 0).x;
  float t0 = distanceTo(face);
  vec4 v0 = interpolated(face);
  for (; (steps & 0xffffffu) < uint(mostSteps); steps++) {
    Corner c = cornerAt(ray, apex);
    vec3 to = vec3(edgeOf(face.p.offset, c.offset), edgeOf(face.q.offset, c.offset), edgeOf(face.r.offset, c.offset));
    bool leftP = isLeft(to.x, face.p, c), leftQ = isLeft(to.y, face.q, c), leftR = isLeft(to.z, face.r, c);
    // The apex takes the place of one corner: of the one that lies between a left and a right edge.
    bool dropsP = leftR && !leftQ, dropsQ = leftP && !leftR, dropsR = leftQ && !leftP;
    if (!dropsP && !dropsQ && !dropsR) {
      // A compiler has rounded one vertex in two ways, and the ray runs next to it: then to what is least wrong.
      steps |= 1u << 24;
      vec3 wrong = max(-to.zxy, to.yzx);
      dropsP = wrong.x <= min(wrong.y, wrong.z);
      dropsQ = !dropsP && wrong.y <= wrong.z;
    }
    uint dropped;
    if (dropsP) {
      dropped = face.p.vertex;
      face.edges = vec3(face.edges.x, to.z, -to.y);
      face.p = c;
    } else if (dropsQ) {
      dropped = face.q.vertex;
      face.edges = vec3(-to.z, face.edges.y, to.x);
      face.q = c;
    } else {
      dropped = face.r.vertex;
      face.edges = vec3(to.y, -to.x, face.edges.z);
      face.r = c;
    }
    float t1 = distanceTo(face);
#ifdef CELLS
    vec4 v1 = texelFetch(colors, place(cell), 0);
    v0 = v1;
#else
    vec4 v1 = interpolated(face);
#endif
    absorbCrossing(light, span, t0, v0, t1, v1);
    if (light.transmittance <= OPAQUE || t1 >= span.far) return false;
    // Rows of a cell are in the order of its vertices.
    uint rank = uint(face.p.vertex < dropped) + uint(face.q.vertex < dropped) + uint(face.r.vertex < dropped);
    uvec4 behind = texelFetch(links, place(4u * cell + rank), 0);
    if (behind.x == NONE) {
      steps++;
      return true;
    }
    cell = behind.x;
    apex = behind.y;
    t0 = t1;
    v0 = v1;
  }
  steps |= 1u << 25;
  return false;
}

void main() {
  Ray ray = rayThrough(vec2(gl_FragCoord.x, height - gl_FragCoord.y));
  Light light = Light(vec3(0.0), 1.0);
  uint steps = 0u;
  // The mesh lies in a ball around the origin.
  if (dot(ray.origin, ray.origin) < 0.76) {
    Span span = spanOf(ray);
    float reached = -INFINITE;
    int entry = -1;
    while ((entry = nextEntry(ray, reached, entry)) >= 0) {
      if (reached >= span.far || !walk(ray, span, entry, light, steps)) break;
    }
  }
  pixel = vec4(light.color + light.transmittance * background, 1.0);
  audit = steps;
}
