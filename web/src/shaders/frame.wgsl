// What is the same for all rays of a picture; frames.ts fills it in.
struct Frame {
  eye: vec4f,
  right: vec4f,
  down: vec4f,
  forward: vec4f,
  lens: vec4f,        // fx, fy, cx, cy in pixels
  clip: vec4f,        // half-space that is seen; all zero: everything
  background: vec4f,  // linear RGB
  density: f32,       // factor of all densities
  nodeCount: i32,
  knotCount: i32,
  mostSteps: i32,
  width: i32,
  height: i32,
  firstRow: i32,      // rows that are drawn, from the top
  lastRow: i32,
}
