/* Built from web/src by 'make page'; sources c9ab833e8eaff22294cc7a8b8884f301dd6300e469a2c5261eface2dfd104d89 */
"use strict";(()=>{var _=Math.PI/24;function J(n,e,t){let o=new Map;n.addEventListener("pointerdown",r=>{n.setPointerCapture(r.pointerId),o.set(r.pointerId,[r.clientX,r.clientY]),n.classList.add("held")});for(let r of["pointerup","pointercancel"])n.addEventListener(r,i=>{o.delete(i.pointerId),o.size||n.classList.remove("held")});n.addEventListener("pointermove",r=>{let i=o.get(r.pointerId);if(!i)return;let s=Math.min(n.clientWidth,n.clientHeight),a=[r.clientX,r.clientY],c=[(a[0]-i[0])/s,(a[1]-i[1])/s],l=[...o].find(([d])=>d!==r.pointerId)?.[1];if(l){e.pan(c[0]/2,c[1]/2);let d=f=>Math.hypot(f[0]-l[0],f[1]-l[1]);e.zoom(d(i)/Math.max(d(a),1))}else r.shiftKey||r.buttons&6?e.pan(c[0],c[1]):e.turn(Math.PI*c[0],Math.PI*c[1]);o.set(r.pointerId,a),t()}),n.addEventListener("wheel",r=>{r.preventDefault();let i=r.deltaY*(r.deltaMode===1?16:r.deltaMode===2?400:1);e.zoom(Math.exp(Math.min(Math.max(i,-300),300)/600)),t()},{passive:!1}),n.addEventListener("contextmenu",r=>r.preventDefault()),n.addEventListener("keydown",r=>{let i=Ae[r.key];!i||r.ctrlKey||r.metaKey||r.altKey||(r.preventDefault(),i(e),t())})}var Ae={ArrowLeft:n=>n.turn(-_,0),ArrowRight:n=>n.turn(_,0),ArrowUp:n=>n.turn(0,-_),ArrowDown:n=>n.turn(0,_),"+":n=>n.zoom(.9),"=":n=>n.zoom(.9),"-":n=>n.zoom(1/.9),r:n=>n.reset(),R:n=>n.reset()};function u(n,e={},...t){let o=Object.assign(document.createElement(n),e);return o.append(...t),o}function g(n,...e){return u("label",{className:"row"},u("span",{},n),...e)}function X(n,e,t,o){let r=u("input",{type:"range"});return Object.assign(r,{min:String(n),max:String(e),step:String((e-n)/400)}),r.value=String(t),r.addEventListener("input",()=>o(Number(r.value))),r}function $(n,e,t){let o=u("select",{},...n.map(r=>u("option",{},r)));return o.selectedIndex=e,o.addEventListener("change",()=>t(o.selectedIndex)),o}function K(n,e){let t=u("input",{type:"checkbox",checked:n});return t.addEventListener("change",()=>e(t.checked)),t}function D(n,e){let t=u("input",{type:"color",value:R(n)});return t.addEventListener("input",()=>e(ke(t.value))),t}function R(n){return`#${n.map(t=>Math.round(255*Math.min(Math.max(t,0),1))).map(t=>t.toString(16).padStart(2,"0")).join("")}`}function ke(n){let[e,t,o]=[1,3,5].map(r=>parseInt(n.slice(r,r+2),16)/255);return[e,t,o]}function A(n){let e=Math.abs(n);return e!==0&&(e<.001||e>=1e6)?n.toExponential(2):String(Number(n.toPrecision(e>=1e3?6:3)))}function y(n){return String(Math.round(n)).replace(/\B(?=(\d{3})+$)/g,"\u202F")}function Le(n,e,t,o){let r=[-.4886025119029199*e,.4886025119029199*t,-.4886025119029199*n];if(o<2)return r;let[i,s,a]=[n*n,e*e,t*t];return r.push(1.0925484305920792*n*e,-1.0925484305920792*e*t,.31539156525252005*(2*a-i-s),-1.0925484305920792*n*t,.5462742152960396*(i-s)),o<3||r.push(-.5900435899266435*e*(3*i-s),2.890611442640554*n*e*t,-.4570457994644658*e*(4*a-i-s),.3731763325901154*t*(2*a-3*i-3*s),-.4570457994644658*n*(4*a-i-s),1.445305721320277*t*(i-s),-.5900435899266435*n*(i-3*s)),r}function ee(n,e,t,o,r,i){let s=t.length/3,a=o.length/s;for(let c=0;c<s;c++){let l=t[3*c]-i[0],d=t[3*c+1]-i[1],f=t[3*c+2]-i[2],h=1/(Math.hypot(l,d,f)||1),p=Le(l*h,d*h,f*h,r),[x,I,U]=[e[4*c],e[4*c+1],e[4*c+2]];for(let T=0,L=c*a;T<p.length;T++,L+=3)x+=p[T]*o[L],I+=p[T]*o[L+1],U+=p[T]*o[L+2];n[4*c]=Math.max(x,0),n[4*c+1]=Math.max(I,0),n[4*c+2]=Math.max(U,0)}}function te(n,e){let t=e.length/5,o=new Float64Array(t);for(let a=0;a<t;a++)o[a]=Se(n,e,a);let r=Uint32Array.from(o.keys()).sort((a,c)=>o[a]-o[c]),i=new Uint32Array(8*t);r.forEach((a,c)=>i.set(e.subarray(5*a,5*a+5),8*c));let s=[];return t&&j(s,n,i,0,t),{nodes:Float32Array.from(s),faces:i}}function j(n,e,t,o,r){let i=n.length;n.push(0,0,0,0,0,0,0,-1);let s;if(r-o<=3)s=Re(e,t,o,r),n[i+7]=8*o+(r-o);else{let a=o+r>>1,c=j(n,e,t,o,a),l=j(n,e,t,a,r);s=c.map((d,f)=>f<3?Math.min(d,l[f]):Math.max(d,l[f]))}for(let a=0;a<3;a++)n[i+a]=s[a],n[i+4+a]=s[3+a];return n[i+3]=n.length/8,s}function Re(n,e,t,o){let r=[1/0,1/0,1/0,-1/0,-1/0,-1/0];for(let i=t;i<o;i++)for(let s=0;s<3;s++)for(let a=0;a<3;a++){let c=n[3*e[8*i+s]+a];r[a]=Math.min(r[a],c-4e-6),r[3+a]=Math.max(r[3+a],c+4e-6)}return r}function Se(n,e,t){let o=0,r=[0,1,2].map(i=>{let s=0;for(let a=0;a<3;a++)s+=n[3*e[5*t+a]+i];return Math.min(1023,Math.max(0,Math.floor((s/3+.5)*1024)))});for(let i=9;i>=0;i--)for(let s of r)o=2*o+(s>>i&1);return o}var re=`// Linear density and linear colour along a crossing, integrated exactly: see difftetvr/optics/special.py, of which
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
`;var ne=`// Scalars through a piecewise-linear transfer function, cut at its knots: see
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
`;var oe=`// A ray's way through the mesh, from cell to cell: see difftetvr/rendering/traversal/walk.py for the method.
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
`;var ie=`#version 300 es
void main() {
  // One triangle that covers the screen.
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`,Ce=`#version 300 es
precision highp float;
uniform sampler2D source;
uniform vec2 size;
out vec4 pixel;
void main() { pixel = vec4(texture(source, gl_FragCoord.xy / size).rgb, 1.0); }`;function se(n){return ce(n,ie,Ce)}function ae(n,e,t){let o=e.location==="cell",r=e.kind==="scalar",s=["#version 300 es",...[o?"CELLS":r?"":"VERTEX_COLORS",r?"SCALARS":""].filter(Boolean).map(a=>`#define ${a}`),`#define WIDTH_BITS ${t}u`,`#define WIDTH_MASK ${2**t-1}u`,"precision highp float;",Ie(e.optics),re,r?`precision highp sampler2D;
`+ne:"",oe].join(`
`);return ce(n,ie,s)}function Ie(n){let e=t=>`float[](${t.map(k).join(", ")})`;return[`const float THIN = ${k(n.thin)}, VISIBLE = ${k(n.visible)};`,`const int NODE_COUNT = ${n.nodes.length};`,`const float NODES[NODE_COUNT] = ${e(n.nodes)};`,`const float WEIGHTS[NODE_COUNT] = ${e(n.weights)};`,`float H_OF(float x) { return ${M(n.h.map(k),"x")}; }`,`float SINH_OF(float x) { return ${M(n.sinh.map(k),"x")}; }`,`float P_OF(float x) { return ${M(n.p.map(k),"x")}; }`,`float U_OF(float x, float y) { return ${M(n.u.map(t=>M(t.map(k),"x")),"y")}; }`].join(`
`)}function k(n){let e=String(n);return/[.e]/.test(e)?e:`${e}.0`}function M(n,e){return n.reduceRight((t,o)=>`(${o} + ${e} * ${t})`)}function ce(n,e,t){let o=n.createProgram();for(let[r,i]of[[n.VERTEX_SHADER,e],[n.FRAGMENT_SHADER,t]]){let s=n.createShader(r);n.shaderSource(s,i),n.compileShader(s),n.attachShader(o,s),n.deleteShader(s)}if(n.linkProgram(o),!n.getProgramParameter(o,n.LINK_STATUS)){let r=(n.getAttachedShaders(o)??[]).map(i=>n.getShaderInfoLog(i));throw new Error(`The shaders of this page do not compile here: ${r.join(" ")} ${n.getProgramInfoLog(o)}`)}return o}var Ue=[[1,3,2],[0,2,3],[0,3,1],[0,1,2]],Ne=[[1,2,3],[0,2,3],[0,1,3],[0,1,2]];function le(n,e){let t=n.length,o=new Uint32Array(2*t).fill(4294967295),r=2**Math.ceil(Math.log2(2*t)),i=new Int32Array(r).fill(-1),s=(c,l)=>n[(c&-4)+Ne[c&3][l]],a=0;for(let c=0;c<t;c++){let[l,d,f]=[s(c,0),s(c,1),s(c,2)],h=_e(l,d,f)&r-1;for(;i[h]>=0;h=h+1&r-1){let x=i[h];if(s(x,0)===l&&s(x,1)===d&&s(x,2)===f)break}let p=i[h];p<0?(i[h]=c,a++):(o.set([p>>2,n[p]],2*c),o.set([c>>2,n[c]],2*p),a--)}return{links:o,boundary:De(n,e,o,a)}}function _e(n,e,t){let o=Math.imul(n,2654435761)^Math.imul(e,2246822507)^Math.imul(t,3266489909);return o^=o>>>15,o=Math.imul(o,739982445),(o^o>>>13)>>>0}function De(n,e,t,o){let r=new Uint32Array(5*o),i=0;for(let s=0;s<n.length;s++){if(t[2*s]!==4294967295)continue;let a=s>>2,[c,l,d]=Ue[s&3].map(f=>n[4*a+f]);r.set(e[a]?[c,d,l,n[s],a]:[c,l,d,n[s],a],5*i++)}return r}var Q=16384,S=class{constructor(e,t,o){this.gl=e;this.width=t;this.height=o;this.frame=e.createFramebuffer(),e.bindFramebuffer(e.FRAMEBUFFER,this.frame),this.color=this.attached(0,e.RGBA8,e.LINEAR),this.records=this.attached(1,e.R32UI,e.NEAREST),e.drawBuffers([e.COLOR_ATTACHMENT0,e.COLOR_ATTACHMENT1])}pixels(){let{gl:e,width:t,height:o}=this,r=new Uint8Array(4*t*o);e.bindFramebuffer(e.READ_FRAMEBUFFER,this.frame),e.readBuffer(e.COLOR_ATTACHMENT0),e.readPixels(0,0,t,o,e.RGBA,e.UNSIGNED_BYTE,r);let i=new Uint8Array(r.length);for(let s=0;s<o;s++)i.set(r.subarray(4*t*s,4*t*(s+1)),4*t*(o-1-s));return i}audit(){let{gl:e,width:t,height:o}=this,r=new Uint32Array(t*o);e.bindFramebuffer(e.READ_FRAMEBUFFER,this.frame),e.readBuffer(e.COLOR_ATTACHMENT1),e.readPixels(0,0,t,o,e.RED_INTEGER,e.UNSIGNED_INT,r),e.readBuffer(e.COLOR_ATTACHMENT0);let i={rays:r.length,mostSteps:0,meanSteps:0,lost:0,bounded:0};for(let s of r){let a=s&16777215;i.mostSteps=Math.max(i.mostSteps,a),i.meanSteps+=a/r.length,i.lost+=s>>24&1,i.bounded+=s>>25&1}return i}delete(){this.gl.deleteTexture(this.color),this.gl.deleteTexture(this.records),this.gl.deleteFramebuffer(this.frame)}attached(e,t,o){let{gl:r}=this,i=r.createTexture();r.bindTexture(r.TEXTURE_2D,i),r.texStorage2D(r.TEXTURE_2D,1,t,this.width,this.height);for(let s of[r.TEXTURE_MIN_FILTER,r.TEXTURE_MAG_FILTER])r.texParameteri(r.TEXTURE_2D,s,o);for(let s of[r.TEXTURE_WRAP_S,r.TEXTURE_WRAP_T])r.texParameteri(r.TEXTURE_2D,s,r.CLAMP_TO_EDGE);return r.framebufferTexture2D(r.FRAMEBUFFER,r.COLOR_ATTACHMENT0+e,r.TEXTURE_2D,i,0),i}},P=class{constructor(e,t){this.gl=e;this.volume=t;this.uniforms=new Map;this.textures=new Map;this.knotCount=0;this.seenBy="";let{header:o,positions:r,cells:i,odd:s,values:a}=t;this.widthBits=e.getParameter(e.MAX_TEXTURE_SIZE)>=4096?12:11,this.program=ae(e,o,this.widthBits),this.copying=se(e);let c=le(i,s),l=te(r,c.boundary);this.nodeCount=l.nodes.length/8;let d=new Float32Array(4*o.vertices);for(let h=0;h<o.vertices;h++)d.set(r.subarray(3*h,3*h+3),4*h),o.location==="vertex"&&(d[4*h+3]=a[4*h+3]);this.addTable("vertices",e.RGBA32F,d,4),this.addTable("links",e.RG32UI,c.links,2),this.addTable("faces",e.RGBA32UI,l.faces,4),this.addTable("nodes",e.RGBA32F,l.nodes,4),this.places=t.harmonics?Pe(t):null,this.seen=a.slice();let f=o.kind==="color"||o.location==="cell";this.addTable("colors",e.RGBA32F,f?this.seen:new Float32Array(4),4),o.transfer&&this.setTransfer(o.transfer)}setTransfer(e){let{gl:t}=this,o=e.scalar.length,r=new Float32Array(8*o);for(let i=0;i<o;i++)r[4*i]=e.scalar[i],r.set([...e.color[i],e.opacity[i]*e.density],4*(o+i));t.bindTexture(t.TEXTURE_2D,this.textureOf("knots")),t.texImage2D(t.TEXTURE_2D,0,t.RGBA32F,o,2,0,t.RGBA,t.FLOAT,r),this.knotCount=o}draw(e,t,o,r=0,i=t.height){let{gl:s}=this;this.colorFor(t.eye,o.directional),s.useProgram(this.program),s.bindFramebuffer(s.FRAMEBUFFER,e.frame),s.viewport(0,0,t.width,t.height),s.enable(s.SCISSOR_TEST),s.scissor(0,r,t.width,i-r);let a=0;for(let[c,l]of this.textures)s.activeTexture(s.TEXTURE0+a),s.bindTexture(s.TEXTURE_2D,l),s.uniform1i(this.uniform(c),a++);s.uniform3fv(this.uniform("eye"),t.eye),s.uniformMatrix3fv(this.uniform("axes"),!1,[...t.right,...t.down,...t.forward]),s.uniform4fv(this.uniform("lens"),t.lens),s.uniform1f(this.uniform("height"),t.height),s.uniform4fv(this.uniform("clip"),o.clip??[0,0,0,0]),s.uniform3fv(this.uniform("background"),o.background),s.uniform1f(this.uniform("densityScale"),o.density),s.uniform1i(this.uniform("nodeCount"),this.nodeCount),s.uniform1i(this.uniform("knotCount"),this.knotCount),s.uniform1i(this.uniform("mostSteps"),Q),s.drawArrays(s.TRIANGLES,0,3),s.disable(s.SCISSOR_TEST),s.activeTexture(s.TEXTURE0)}present(e){let{gl:t}=this;t.useProgram(this.copying),t.bindFramebuffer(t.FRAMEBUFFER,null),t.viewport(0,0,t.drawingBufferWidth,t.drawingBufferHeight),t.bindTexture(t.TEXTURE_2D,e.color),t.uniform2f(t.getUniformLocation(this.copying,"size"),t.drawingBufferWidth,t.drawingBufferHeight),t.drawArrays(t.TRIANGLES,0,3),t.bindTexture(t.TEXTURE_2D,null)}colorFor(e,t){let{harmonics:o,values:r}=this.volume,i=t?e.join():"";!o||!this.places||i===this.seenBy||(t?ee(this.seen,r,this.places,o.coefficients,o.degree,e):this.seen.set(r),this.addTable("colors",this.gl.RGBA32F,this.seen,4),this.seenBy=i)}uniform(e){return this.uniforms.has(e)||this.uniforms.set(e,this.gl.getUniformLocation(this.program,e)),this.uniforms.get(e)}textureOf(e){let{gl:t}=this,o=this.textures.get(e);if(o)return o;let r=t.createTexture();this.textures.set(e,r),t.bindTexture(t.TEXTURE_2D,r);for(let i of[t.TEXTURE_MIN_FILTER,t.TEXTURE_MAG_FILTER])t.texParameteri(t.TEXTURE_2D,i,t.NEAREST);return r}addTable(e,t,o,r){let{gl:i}=this,s=2**this.widthBits,a=o.length/r,c=Math.max(1,Math.ceil(a/s));if(c>i.getParameter(i.MAX_TEXTURE_SIZE))throw new Error("This browser's textures are too small for a volume of so many cells; open it on another machine.");let l=t===i.RGBA32F?i.RGBA:r===2?i.RG_INTEGER:i.RGBA_INTEGER,d=o instanceof Float32Array?i.FLOAT:i.UNSIGNED_INT,f=!this.textures.has(e);i.bindTexture(i.TEXTURE_2D,this.textureOf(e)),f&&i.texStorage2D(i.TEXTURE_2D,1,t,s,c);let h=Math.floor(a/s),p=o.subarray(h*s*r);h&&i.texSubImage2D(i.TEXTURE_2D,0,0,0,s,h,l,d,o,0),p.length&&i.texSubImage2D(i.TEXTURE_2D,0,0,h,p.length/r,1,l,d,p,0)}};function Pe(n){let{header:e,positions:t,cells:o}=n;if(e.location==="vertex")return t;let r=new Float32Array(3*e.cells);return o.forEach((i,s)=>{for(let a=0;a<3;a++)r[3*(s>>2)+a]+=t[3*i+a]/4}),r}var v=264,w=132,m=9,He=12,V=class{constructor(e,t,o){this.original=e;this.changed=o;this.knots=[];this.chosen=-1;this.canvas=u("canvas",{className:"curve",tabIndex:0});this.picker=D([1,1,1],e=>this.paint(e));this.note=u("output");this.histogram=Ve(t),this.canvas.setAttribute("aria-label","Opacity of scalars: knots to drag");let r=u("button",{type:"button",textContent:"Reset"});r.addEventListener("click",()=>this.reset()),this.element=u("div",{},this.canvas,u("div",{className:"ends"},A(e.range[0]),this.note,A(e.range[1])),g("Colour of the knot",this.picker,r),u("p",{className:"hint"},"Drag knots; double-click adds or removes one."));let i=Math.max(1,window.devicePixelRatio);[this.canvas.width,this.canvas.height]=[v*i,w*i],this.canvas.getContext("2d").scale(i,i),this.listen(),this.load()}load(){let{scalar:e,opacity:t,color:o}=this.original;this.knots=e.map((r,i)=>({scalar:r,opacity:t[i],color:o[i]})),this.choose(-1)}reset(){this.load(),this.tell()}tell(){this.changed({...this.original,scalar:this.knots.map(e=>e.scalar),opacity:this.knots.map(e=>e.opacity),color:this.knots.map(e=>e.color)}),this.draw()}choose(e){this.chosen=e,this.picker.disabled=e<0,e>=0&&(this.picker.value=R(this.knots[e].color)),this.draw()}paint(e){this.chosen<0||(this.knots[this.chosen].color=e,this.tell())}listen(){let{canvas:e}=this,t=!1,o=r=>{let i=e.getBoundingClientRect();return[(r.clientX-i.left)*v/i.width,(r.clientY-i.top)*w/i.height]};e.addEventListener("pointerdown",r=>{e.setPointerCapture(r.pointerId);let[i,s]=o(r);this.choose(this.nearest(i,s)),t=this.chosen>=0}),e.addEventListener("pointermove",r=>{if(!t)return;let[i,s]=o(r);this.move(H(i),de(s))}),e.addEventListener("pointerup",()=>t=!1),e.addEventListener("dblclick",r=>{let[i,s]=o(r),a=this.nearest(i,s);a>=0?this.remove(a):this.insert(H(i),de(s))}),e.addEventListener("keydown",r=>{(r.key==="Delete"||r.key==="Backspace")&&this.remove(this.chosen)})}nearest(e,t){let[o,r]=[-1,He];return this.knots.forEach((i,s)=>{let a=Math.hypot(he(i.scalar)-e,F(i.opacity)-t);a<r&&([o,r]=[s,a])}),o}move(e,t){let o=this.knots[this.chosen],[r,i]=[this.knots[this.chosen-1]?.scalar??0,this.knots[this.chosen+1]?.scalar??1];o.scalar=Math.min(Math.max(e,r),i),o.opacity=t,this.tell()}insert(e,t){let o=this.knots.filter(r=>r.scalar<=e).length;this.knots.splice(o,0,{scalar:e,opacity:t,color:this.valueAt(e).color}),this.choose(o),this.tell()}remove(e){e<0||this.knots.length<2||(this.knots.splice(e,1),this.choose(-1),this.tell())}valueAt(e){let t=this.knots.findIndex(c=>c.scalar>e);if(t<0)return this.knots[this.knots.length-1];if(t===0)return this.knots[0];let[o,r]=[this.knots[t-1],this.knots[t]],i=(e-o.scalar)/(r.scalar-o.scalar||1),s=(c,l)=>c+i*(l-c),a=o.color.map((c,l)=>s(c,r.color[l]));return{scalar:e,opacity:s(o.opacity,r.opacity),color:a}}draw(){let e=this.canvas.getContext("2d");e.clearRect(0,0,v,w);let t=w-m,o=(v-2*m)/this.histogram.length;e.fillStyle="rgb(255 255 255 / 0.13)",this.histogram.forEach((r,i)=>{e.fillRect(m+i*o,t-r*(t-m),o,r*(t-m))});for(let r=m;r<v-m;r++){let i=this.valueAt(H(r+.5));e.fillStyle=`${R(i.color)}d0`,e.fillRect(r,F(i.opacity),1,t-F(i.opacity)),e.fillStyle=R(i.color),e.fillRect(r,t,1,m-2)}e.strokeStyle="rgb(255 255 255 / 0.85)",e.lineWidth=1.5,e.beginPath();for(let r=m;r<=v-m;r++)e.lineTo(r,F(this.valueAt(H(r)).opacity));e.stroke(),this.knots.forEach((r,i)=>{e.beginPath(),e.arc(he(r.scalar),F(r.opacity),i===this.chosen?6.5:5,0,7),e.fillStyle=R(r.color),e.fill(),e.strokeStyle=i===this.chosen?"#7cc4ff":"#fff",e.lineWidth=i===this.chosen?2.5:1.5,e.stroke()}),this.note.textContent=this.chosen<0?"":this.describe(this.knots[this.chosen])}describe(e){let[t,o]=this.original.range;return`${A(t+e.scalar*(o-t))}: opacity ${A(e.opacity)}`}},he=n=>m+n*(v-2*m),H=n=>Math.min(Math.max((n-m)/(v-2*m),0),1),F=n=>w-m-Math.sqrt(n)*(w-2*m),de=n=>Math.min(Math.max((w-m-n)/(w-2*m),0),1)**2;function Ve(n){let e=new Array(66).fill(0);for(let o=3;o<n.length;o+=4)n[o]>=0&&n[o]<=1&&e[Math.min(65,Math.floor(n[o]*66))]++;let t=Math.max(1,...e);return e.map(o=>Math.sqrt(o/t))}var Be=[.5,1,2],fe=["x","y","z"],ue=700,Ge=324;function pe(n,e,t,o){let{header:r}=n,i=u("div",{className:"body"});if(r.transfer){let f=new V(r.transfer,n.values,h=>{e.setTransfer(h),t.change()});i.append(Y(r.scalar??"Scalar",f.element))}i.append(Y("Picture",...qe(n,t,o)),Y("Cut",...ze(n,t))),i.append(We(n,t));let s=u("button",{type:"button",className:"toggle",title:"Show or hide the panel"}),a=u("h1",{},r.title),c=u("aside",{className:"panel"},u("header",{},a,s),i),l=f=>{c.classList.toggle("closed",!f),s.textContent=f?"\u2212":"+",s.setAttribute("aria-expanded",String(f)),d()},d=()=>{let f=window.innerWidth>=ue,h=!c.classList.contains("closed");t.covered=h?f?[Ge/window.innerWidth,0]:[0,.5]:[0,0],t.change()};return window.addEventListener("resize",d),s.addEventListener("click",()=>l(c.classList.contains("closed"))),l(window.innerWidth>=ue),c}function Y(n,...e){return u("section",{},u("h2",{},n),...e)}function qe(n,e,t){let{look:o}=e,r=h=>p=>{h(p),e.change()},i=X(-3,3,0,r(h=>o.density=2**h)),a=$(["Fast","Normal","Fine"],1,r(h=>e.quality=Be[h])),c=D(o.background,r(h=>o.background=h));c.addEventListener("input",()=>document.documentElement.style.background=c.value);let l=[g("Density",i),g("Quality",a),g("Background",c)];if(n.harmonics){let h=K(!0,r(p=>o.directional=p));l.push(g("Colour by direction",h))}let d=u("button",{type:"button",textContent:"Reset view"});d.addEventListener("click",()=>{t.reset(),e.change()});let f=u("button",{type:"button",textContent:"Save picture"});return f.addEventListener("click",async()=>{let h=await e.picture();if(!h)return;let p=URL.createObjectURL(h);u("a",{href:p,download:`${n.header.title}.png`}).click(),URL.revokeObjectURL(p)}),[...l,u("div",{className:"buttons"},d,f)]}function ze({header:{box:n}},e){let t={axis:-1,place:0,isFlipped:!1},o=X(-.5,.5,0,c=>s({place:c})),r=u("output",{className:"where"}),i=K(!1,c=>s({isFlipped:c})),s=c=>{Object.assign(t,c),o.disabled=i.disabled=t.axis<0;let l=t.isFlipped?1:-1,d=fe.map((f,h)=>h===t.axis?l:0);r.textContent=t.axis<0?"":A(n.center[t.axis]+n.size*t.place),e.look.clip=t.axis<0?null:[d[0],d[1],d[2],-l*t.place],e.change()},a=$(["Nothing",...fe.map(c=>`Across ${c}`)],0,c=>s({axis:c-1}));return o.disabled=i.disabled=!0,[g("Cut away",a),g("Place",r,o),g("Other side",i)]}function We(n,e){let{header:t}=n,o=u("p",{className:"drawn"},"\u2026");e.onFinished=i=>{o.replaceChildren(...Xe(i).flatMap(s=>[s,u("br")]))};let r=`${y(t.cells)} cells, ${y(t.vertices)} vertices`;return u("section",{className:"statistics"},u("p",{},r),o)}function Xe({width:n,height:e,milliseconds:t,audit:o}){return[`${n} \xD7 ${e} pixels in ${y(t)} ms`,`${y(o.meanSteps)} cells a ray, at most ${y(o.mostSteps)}`,`${y(o.lost)} rays lost, ${y(o.bounded)} ended at ${y(Q)} cells`]}var me=`* {
  box-sizing: border-box;
}
html,
body {
  height: 100%;
  margin: 0;
  overflow: hidden;
  font: 13px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif;
  color: #e8eaed;
}
.picture {
  position: fixed;
  inset: 0;
  width: 100%;
  height: 100%;
  display: block;
  cursor: grab;
  touch-action: none;
  outline: none;
}
.picture.held {
  cursor: grabbing;
}
.picture:focus-visible {
  box-shadow: inset 0 0 0 2px #7cc4ff;
}
#poster {
  z-index: 1;
  pointer-events: none;
  transition: opacity 0.25s;
}
#poster.gone {
  opacity: 0;
}
.panel {
  position: fixed;
  z-index: 2;
  top: 14px;
  right: 14px;
  width: 296px;
  max-height: calc(100% - 28px);
  display: flex;
  flex-direction: column;
  background: rgb(22 25 30 / 0.86);
  backdrop-filter: blur(10px);
  border: 1px solid rgb(255 255 255 / 0.1);
  border-radius: 12px;
  box-shadow: 0 8px 30px rgb(0 0 0 / 0.35);
}
.panel header {
  display: flex;
  align-items: center;
  gap: 8px;
  padding: 10px 10px 10px 16px;
}
h1 {
  flex: 1;
  margin: 0;
  font-size: 14px;
  font-weight: 600;
  overflow: hidden;
  text-overflow: ellipsis;
  white-space: nowrap;
}
h2 {
  margin: 0 0 8px;
  font-size: 11px;
  font-weight: 600;
  letter-spacing: 0.06em;
  text-transform: uppercase;
  color: #9aa4b0;
}
.panel .body {
  overflow-y: auto;
}
.panel.closed {
  width: auto;
  max-width: 60%;
}
.panel.closed .body {
  display: none;
}
section {
  padding: 12px 16px;
  border-top: 1px solid rgb(255 255 255 / 0.08);
}
.row {
  display: flex;
  align-items: center;
  gap: 10px;
  min-height: 30px;
}
.row > span {
  flex: 1;
  white-space: nowrap;
}
.where {
  color: #9aa4b0;
  font-variant-numeric: tabular-nums;
}
input[type="range"] {
  width: 150px;
  margin: 0;
  accent-color: #5aa9f0;
}
input[type="checkbox"] {
  width: 16px;
  height: 16px;
  margin: 0;
  accent-color: #5aa9f0;
}
input[type="color"] {
  width: 44px;
  height: 24px;
  padding: 0;
  border: 1px solid rgb(255 255 255 / 0.2);
  border-radius: 6px;
  background: none;
  overflow: hidden;
}
input[type="color"]::-webkit-color-swatch-wrapper {
  padding: 0;
}
input[type="color"]::-webkit-color-swatch {
  border: 0;
}
:disabled {
  opacity: 0.4;
}
select,
button {
  font: inherit;
  color: inherit;
  background: rgb(255 255 255 / 0.09);
  border: 1px solid rgb(255 255 255 / 0.12);
  border-radius: 7px;
  padding: 4px 10px;
}
select {
  width: 150px;
}
select option {
  background: #22262d;
}
button {
  cursor: pointer;
}
button:hover {
  background: rgb(255 255 255 / 0.17);
}
.buttons {
  display: flex;
  gap: 8px;
  margin-top: 8px;
}
.buttons button {
  flex: 1;
}
.toggle {
  width: 28px;
  height: 26px;
  padding: 0;
  font-size: 16px;
  line-height: 1;
}
.curve {
  display: block;
  width: 264px;
  height: 132px;
  border-radius: 8px;
  background: rgb(0 0 0 / 0.35);
  touch-action: none;
}
.ends {
  display: flex;
  justify-content: space-between;
  margin: 3px 0 6px;
  color: #9aa4b0;
  font-variant-numeric: tabular-nums;
}
.hint,
.statistics p {
  margin: 0;
  color: #9aa4b0;
  font-size: 12px;
}
.failure {
  position: fixed;
  z-index: 3;
  left: 50%;
  bottom: 24px;
  transform: translateX(-50%);
  max-width: min(90%, 560px);
  margin: 0;
  padding: 12px 18px;
  border-radius: 10px;
  background: rgb(80 20 20 / 0.94);
}
@media (max-width: 699px) {
  .panel:not(.closed) {
    top: auto;
    bottom: 10px;
    left: 10px;
    right: 10px;
    width: auto;
    max-height: calc(50% - 10px);
  }
  .curve {
    width: 100%;
    height: auto;
    aspect-ratio: 2;
  }
}
`;async function ge(n){let e=await je(Ke(n.trim())),t=new DataView(e.buffer,e.byteOffset).getUint32(0,!0),o=JSON.parse(new TextDecoder().decode(e.subarray(4,4+t))),r=new Map,i=4+t;for(let l of o.arrays){r.set(l.name,{entry:l,of:f=>Qe(e,l,d,f)});let d=i;i+=l.rows*l.columns*l.width}let{cells:s,odd:a}=Ze(o,r.get("cells"),r.get("odd")),c=r.get("harmonics");return{header:o,positions:Ye(o,r.get("positions")),cells:s,odd:a,values:Je(r),harmonics:c?tt(c):null}}function Ke(n){let e=Uint8Array.fromBase64;if(e)return e(n);let t=atob(n),o=new Uint8Array(t.length);for(let r=0;r<t.length;r++)o[r]=t.charCodeAt(r);return o}async function je(n){if(typeof DecompressionStream>"u")throw new Error("This browser is too old to unpack the volume; this picture is all it can show.");let e=new Blob([n]).stream().pipeThrough(new DecompressionStream("deflate"));return new Uint8Array(await new Response(e).arrayBuffer())}function Qe(n,e,t,o){let{rows:r,width:i}=e,s=new Int32Array(r);for(let a=0;a<i;a++){let c=t+(o*i+a)*r;for(let l=0;l<r;l++)s[l]|=n[c+l]<<8*a}if(e.differences){let a=0;for(let c=0;c<r;c++){let l=s[c];a+=l&1?-((l>>>1)+1):l>>>1,s[c]=a}}return s}function Ye(n,e){let t=new Float32Array(3*n.vertices),o=2**e.entry.bits-1;for(let r=0;r<3;r++){let i=e.of(r),s=0;for(let a of i)s=Math.max(s,a);for(let a=0;a<i.length;a++)t[3*a+r]=(i[a]-.5*s)/o}return t}function Ze(n,e,t){let o=new Uint32Array(4*n.cells),r=[0,1,2,3].map(l=>e.of(l)),i=t.of(0),s=new Uint8Array(n.cells),a=0,c=0;for(let l=0;l<n.cells;l++){let d=r[0][l];a+=d,c=(d===0&&l>0?c:a)+r[1][l];let f=c+r[2][l];o.set([a,c,f,f+r[3][l]],4*l),s[l]=i[l>>3]>>(l&7)&1}return{cells:o,odd:s}}function Je(n){let e=n.get("scalar");if(e){let s=new Float32Array(4*e.entry.rows),a=e.of(0);for(let c=0;c<a.length;c++)s[4*c+3]=e.entry.low+e.entry.step*a[c];return s}let t=n.get("density"),o=n.get("color"),r=new Float32Array(4*t.entry.rows),i=et();return[o.of(0),o.of(1),o.of(2),t.of(0)].forEach((s,a)=>{let c=(a<3?o:t).entry.dropped;for(let l=0;l<s.length;l++)r[4*l+a]=i[s[l]<<c]}),r}function et(){let n=new Float32Array(65536);for(let e=0;e<n.length;e++){let t=e>>10&31,o=e&1023,r=t===0?o*2**-24:(1024+o)*2**(t-25);n[e]=e&32768?-r:r}return n}function tt(n){let{rows:e,columns:t,scale:o,degree:r}=n.entry,i=new Float32Array(e*t);for(let s=0;s<t;s++){let a=n.of(s);for(let c=0;c<e;c++)i[c*t+s]=(a[c]-128)*o[s]}return{degree:r,coefficients:i}}var be=40,rt=50,nt=150,ye=[1,.7,.5,.35,.25,.18,.125,.09],ot=4096,B=class{constructor(e,t,o,r){this.gl=e;this.renderer=t;this.orbit=o;this.look=r;this.quality=1;this.covered=[0,0];this.onFinished=()=>{};this.onFirst=()=>{};this.scale=3;this.coarse=null;this.fine=null;this.pending=null;this.isDirty=!0;this.changed=0;this.rows=0;this.bandRows=32;this.spent=0;this.isScheduled=!1;this.wasShown=!1;this.waiting=[];new ResizeObserver(()=>this.change()).observe(e.canvas)}change(){this.isDirty=!0,this.rows=0,this.spent=0,this.changed=performance.now(),this.schedule()}async picture(){(!this.fine||this.rows<this.fine.height||this.pending)&&await new Promise(i=>this.waiting.push(i));let{width:e,height:t}=this.fine,o=document.createElement("canvas");o.width=Math.max(Math.round((1-this.covered[0])*e),1),o.height=Math.max(Math.round((1-this.covered[1])*t),1);let r=new ImageData(new Uint8ClampedArray(this.fine.pixels()),e,t);return o.getContext("2d").putImageData(r,0,0),new Promise(i=>o.toBlob(i))}schedule(){this.isScheduled||(this.isScheduled=!0,requestAnimationFrame(()=>{this.isScheduled=!1,this.advance()}))}advance(){let{gl:e}=this;if(e.isContextLost())return;if(this.pending){if(e.getSyncParameter(this.pending.sync,e.SYNC_STATUS)!==e.SIGNALED)return this.schedule();e.deleteSync(this.pending.sync);let{then:o,since:r}=this.pending;this.pending=null,o(performance.now()-r)}let t=e.canvas;!t.clientWidth||!t.clientHeight||(this.isDirty?(this.isDirty=!1,this.drawCoarse(t),this.schedule()):performance.now()-this.changed<nt?this.schedule():(!this.fine||this.rows<this.fine.height)&&(this.drawBand(t),this.schedule()))}drawCoarse(e){let[t,o]=xe(e,1);(e.width!==t||e.height!==o)&&([e.width,e.height]=[t,o]);let r=this.view(e,ye[this.scale]);this.coarse=this.fitting(this.coarse,r);let i=this.coarse;this.renderer.draw(i,r,this.look),this.renderer.present(i),this.after(s=>{s>1.5*be&&(this.scale=Math.min(this.scale+1,ye.length-1)),s<.55*be&&(this.scale=Math.max(this.scale-1,0)),this.wasShown||(this.wasShown=!0,this.onFirst())})}drawBand(e){let t=this.view(e,this.quality);this.fine=this.fitting(this.fine,t);let o=this.fine,r=Math.min(this.rows+this.bandRows,t.height);this.renderer.draw(o,t,this.look,this.rows,r),this.rows=r,this.after(i=>{this.spent+=i;let s=Math.min(Math.max(rt/Math.max(i,1),.5),2);if(this.bandRows=Math.min(Math.max(Math.round(this.bandRows*s),4),4096),this.isDirty||this.rows<t.height)return;this.renderer.present(o);let{width:a,height:c}=o;this.onFinished({width:a,height:c,milliseconds:this.spent,audit:o.audit()});for(let l of this.waiting.splice(0))l()})}view(e,t){let[o,r]=xe(e,t);return this.orbit.view(o,r,this.covered[0]*o,this.covered[1]*r)}fitting(e,t){return e&&e.width===t.width&&e.height===t.height?e:(e?.delete(),new S(this.gl,t.width,t.height))}after(e){let t=this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE,0);this.gl.flush(),this.pending={sync:t,since:performance.now(),then:e}}};function xe(n,e){let t=Math.min(e*window.devicePixelRatio,ot/Math.max(n.clientWidth,n.clientHeight));return[Math.max(1,Math.round(n.clientWidth*t)),Math.max(1,Math.round(n.clientHeight*t))]}var C=(n,e)=>n[0]*e[0]+n[1]*e[1]+n[2]*e[2],b=(n,e,t=1)=>[n[0]+t*e[0],n[1]+t*e[1],n[2]+t*e[2]],E=(n,e)=>[e*n[0],e*n[1],e*n[2]],G=(n,e)=>[n[1]*e[2]-n[2]*e[1],n[2]*e[0]-n[0]*e[2],n[0]*e[1]-n[1]*e[0]],O=n=>E(n,1/(Math.hypot(...n)||1));function ve(n,e,t){let[o,r]=[Math.cos(t),Math.sin(t)];return b(b(E(n,o),G(e,n),r),e,C(e,n)*(1-o))}var it=Math.cos(3*Math.PI/180),q=class{constructor(e){this.opening=e;this.target=[0,0,0];this.up=[0,0,1];this.offset=[0,-1,0];this.fov=.9;this.reset()}reset(){this.target=this.opening.target,this.up=O(this.opening.up),this.offset=b(this.opening.eye,this.opening.target,-1),this.fov=this.opening.fov*Math.PI/180}turn(e,t){let o=ve(this.offset,this.up,-e),r=O(G(this.up,o)),i=ve(o,r,-t),s=Math.abs(C(i,this.up))/Math.hypot(...i);(s<it||s<Math.abs(C(o,this.up))/Math.hypot(...o))&&(o=i),this.offset=o}zoom(e){let t=Math.hypot(...this.offset)*e;this.offset=E(O(this.offset),Math.min(Math.max(t,.02),50))}pan(e,t){let o=2*Math.hypot(...this.offset)*Math.tan(this.fov/2),r=this.view(1,1);this.target=b(b(this.target,r.right,-e*o),r.down,-t*o)}view(e,t,o=0,r=0){let i=[Math.max(e-o,1),Math.max(t-r,1)],s=O(E(this.offset,-1)),a=O(G(s,this.up)),c=.5*Math.min(...i)/Math.tan(this.fov/2);return{eye:b(this.target,this.offset),right:a,down:G(s,a),forward:s,lens:[c,c,i[0]/2,i[1]/2],width:e,height:t}}};async function st(){document.head.append(u("style",{textContent:me}));let n=u("canvas",{className:"picture",tabIndex:0});n.setAttribute("aria-label","The volume; drag to turn it");let e=n.getContext("webgl2",{antialias:!1,alpha:!1,depth:!1});if(!e)throw new Error("This browser has no WebGL 2, or it is switched off; this picture is all it can show.");let t=await ge(document.getElementById("volume").textContent),{header:o}=t,r=new P(e,t),i=new q(o.opening),s={background:o.background,clip:null,density:1,directional:!0},a=new B(e,r,i,s);a.onFirst=()=>document.getElementById("poster")?.classList.add("gone"),n.addEventListener("webglcontextlost",()=>{we(new Error("The graphics driver has given up on this page; load it again, with another quality."))}),J(n,i,()=>a.change()),document.body.append(n,pe(t,r,a,i)),window.difftetvr={header:o,render:c=>at(e,r,t,s,c)},a.change()}function at(n,e,{header:t},o,r){let{center:i,size:s}=t.box,[a,c,l]=r.worldToCamera.slice(0,3).map(W=>W.slice(0,3)),d=r.worldToCamera.slice(0,3).map(W=>W[3]),f=b(b(E(a,-d[0]),c,-d[1]),l,-d[2]),{width:h,height:p,fx:x,fy:I,cx:U,cy:T}=r,L={eye:E(b(f,i,-1),1/s),right:a,down:c,forward:l,lens:[x,I,U,T],width:h,height:p},z=r.clip,Z=z?.slice(0,3),Ee=z&&[...E(Z,s),C(Z,i)+z[3]],N=new S(n,h,p);e.draw(N,L,{...o,background:r.background??o.background,clip:Ee??null});let Te={pixels:ct(N.pixels()),audit:N.audit()};return N.delete(),Te}function ct(n){let e=[];for(let t=0;t<n.length;t+=32768)e.push(String.fromCharCode(...n.subarray(t,t+32768)));return btoa(e.join(""))}function we(n){let e=n instanceof Error?n.message:String(n);document.getElementById("poster")?.classList.remove("gone"),document.body.append(u("p",{className:"failure"},e))}st().catch(we);})();
