// A hierarchy of boxes over the boundary faces, along a Morton curve, laid out so that no stack is needed to search it.

export interface Hierarchy {
  /** (N, 8): lower corner, the node after this one's; upper corner, leaves: first face times 8 plus count, others -1. */
  nodes: Float32Array<ArrayBuffer>;
  /** (F, 8): vertices and apex; cell, and three that are not used. */
  faces: Uint32Array<ArrayBuffer>;
}

const LEAF = 3;
// Boxes are wider than their faces by what a ray's frame moves points (see walk.wgsl), many times over.
const SLACK = 4e-6;

export function hierarchyOf(positions: Float32Array, boundary: Uint32Array): Hierarchy {
  const count = boundary.length / 5;
  const codes = new Float64Array(count);
  for (let face = 0; face < count; face++) codes[face] = codeOf(positions, boundary, face);
  const order = Uint32Array.from(codes.keys()).sort((a, b) => codes[a] - codes[b]);
  const faces = new Uint32Array(8 * count);
  order.forEach((face, place) => faces.set(boundary.subarray(5 * face, 5 * face + 5), 8 * place));
  const nodes: number[] = [];
  if (count) addNode(nodes, positions, faces, 0, count);
  return { nodes: Float32Array.from(nodes), faces };
}

/** Adds the node of some faces and all below it; returns its box. */
function addNode(nodes: number[], positions: Float32Array, faces: Uint32Array, first: number, last: number): number[] {
  const start = nodes.length;
  nodes.push(0, 0, 0, 0, 0, 0, 0, -1);
  let box: number[];
  if (last - first <= LEAF) {
    box = boxOf(positions, faces, first, last);
    nodes[start + 7] = 8 * first + (last - first);
  } else {
    const middle = (first + last) >> 1;
    const left = addNode(nodes, positions, faces, first, middle);
    const right = addNode(nodes, positions, faces, middle, last);
    box = left.map((value, k) => (k < 3 ? Math.min(value, right[k]) : Math.max(value, right[k])));
  }
  for (let k = 0; k < 3; k++) {
    nodes[start + k] = box[k];
    nodes[start + 4 + k] = box[3 + k];
  }
  nodes[start + 3] = nodes.length / 8;
  return box;
}

function boxOf(positions: Float32Array, faces: Uint32Array, first: number, last: number): number[] {
  const box = [Infinity, Infinity, Infinity, -Infinity, -Infinity, -Infinity];
  for (let face = first; face < last; face++) {
    for (let corner = 0; corner < 3; corner++) {
      for (let k = 0; k < 3; k++) {
        const value = positions[3 * faces[8 * face + corner] + k];
        box[k] = Math.min(box[k], value - SLACK);
        box[3 + k] = Math.max(box[3 + k], value + SLACK);
      }
    }
  }
  return box;
}

/** Place of a face's centre along the curve. */
function codeOf(positions: Float32Array, boundary: Uint32Array, face: number): number {
  let code = 0;
  const cell = [0, 1, 2].map((axis) => {
    let sum = 0;
    for (let corner = 0; corner < 3; corner++) sum += positions[3 * boundary[5 * face + corner] + axis];
    return Math.min(1023, Math.max(0, Math.floor((sum / 3 + 0.5) * 1024)));
  });
  for (let bit = 9; bit >= 0; bit--) {
    for (const value of cell) code = 2 * code + ((value >> bit) & 1);
  }
  return code;
}
