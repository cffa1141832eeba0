// Which cells meet, found from their vertices, as in difftetvr/rendering/traversal/walk.py: nothing of it is stored.

export interface Topology {
  /** (4 T, 2): what lies behind the face opposite each cell's r-th vertex, its cell and that one's vertex that is not on
   * the face; NONE and any vertex at the boundary. */
  links: Uint32Array<ArrayBuffer>;
  /** (F, 5) boundary faces: vertices, counter-clockwise for who enters through them, the cell's apex, the cell. */
  boundary: Uint32Array;
}

export const NONE = 0xffffffff;

// Vertices of the face opposite each vertex of a positive cell, counter-clockwise seen along a ray that enters.
const FACES = [
  [1, 3, 2],
  [0, 2, 3],
  [0, 3, 1],
  [0, 1, 2],
];
const ASCENDING = [
  [1, 2, 3],
  [0, 2, 3],
  [0, 1, 3],
  [0, 1, 2],
];

export function topologyOf(cells: Uint32Array, odd: Uint8Array): Topology {
  const halfFaces = cells.length;
  const links = new Uint32Array(2 * halfFaces).fill(NONE);
  const slots = 2 ** Math.ceil(Math.log2(2 * halfFaces));
  const table = new Int32Array(slots).fill(-1);
  const corner = (half: number, k: number) => cells[(half & ~3) + ASCENDING[half & 3][k]];
  let open = 0;
  for (let half = 0; half < halfFaces; half++) {
    const [a, b, c] = [corner(half, 0), corner(half, 1), corner(half, 2)];
    let slot = hashOf(a, b, c) & (slots - 1);
    for (; table[slot] >= 0; slot = (slot + 1) & (slots - 1)) {
      const other = table[slot];
      if (corner(other, 0) === a && corner(other, 1) === b && corner(other, 2) === c) break;
    }
    const other = table[slot];
    if (other < 0) {
      table[slot] = half;
      open++;
    } else {
      links.set([other >> 2, cells[other]], 2 * half);
      links.set([half >> 2, cells[half]], 2 * other);
      open--;
    }
  }
  return { links, boundary: boundaryOf(cells, odd, links, open) };
}

function hashOf(a: number, b: number, c: number): number {
  let hash = Math.imul(a, 0x9e3779b1) ^ Math.imul(b, 0x85ebca6b) ^ Math.imul(c, 0xc2b2ae35);
  hash ^= hash >>> 15;
  hash = Math.imul(hash, 0x2c1b3c6d);
  return (hash ^ (hash >>> 13)) >>> 0;
}

function boundaryOf(cells: Uint32Array, odd: Uint8Array, links: Uint32Array, count: number): Uint32Array {
  const faces = new Uint32Array(5 * count);
  let next = 0;
  for (let half = 0; half < cells.length; half++) {
    if (links[2 * half] !== NONE) continue;
    const cell = half >> 2;
    const [i, j, k] = FACES[half & 3].map((corner) => cells[4 * cell + corner]);
    faces.set(odd[cell] ? [i, k, j, cells[half], cell] : [i, j, k, cells[half], cell], 5 * next++);
  }
  return faces;
}
