// What the page holds: the inverse of difftetvr/view/page/packing.py and scene.py.

export type Vector = [number, number, number];

export interface TransferKnots {
  scalar: number[];
  opacity: number[];
  color: Vector[];
  /** Density of opacity 1, where the mesh's longest side is 1. */
  density: number;
  /** Scalars that stand for 0 and 1. */
  range: [number, number];
}

export interface Opening {
  eye: Vector;
  target: Vector;
  up: Vector;
  /** Degrees, of the shorter side of the window. */
  fov: number;
}

export interface Header {
  vertices: number;
  cells: number;
  location: "vertex" | "cell";
  kind: "color" | "scalar";
  box: { center: Vector; size: number };
  optics: Optics;
  transfer?: TransferKnots;
  opening: Opening;
  background: Vector;
  title: string;
  scalar: string | null;
  arrays: PackedArray[];
}

export interface Optics {
  thin: number;
  visible: number;
  h: number[];
  sinh: number[];
  p: number[];
  u: number[][];
  nodes: number[];
  weights: number[];
}

interface PackedArray {
  name: string;
  rows: number;
  columns: number;
  width: number;
  differences: boolean;
  bits?: number;
  low?: number;
  step?: number;
  dropped?: number;
  scale?: number[];
  degree?: number;
}

export interface Harmonics {
  degree: number;
  /** (N, 3 B), function by function, three colours each. */
  coefficients: Float32Array;
}

export interface Volume {
  header: Header;
  /** (V, 3), from -0.5 to 0.5 along the longest side. */
  positions: Float32Array;
  /** (T, 4), ascending in each cell. */
  cells: Uint32Array;
  /** Whether the ascending order of a cell is an odd permutation of the positive one. */
  odd: Uint8Array;
  /** (N, 4) linear RGB and density; of scalars, the scalar is the last and the others are not used. */
  values: Float32Array<ArrayBuffer>;
  harmonics: Harmonics | null;
}

export async function unpack(text: string): Promise<Volume> {
  const content = await inflated(bytesOf(text.trim()));
  const length = new DataView(content.buffer, content.byteOffset).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(content.subarray(4, 4 + length))) as Header;
  const columns = new Map<string, Columns>();
  let offset = 4 + length;
  for (const entry of header.arrays) {
    columns.set(entry.name, { entry, of: (column) => columnOf(content, entry, first, column) });
    const first = offset;
    offset += entry.rows * entry.columns * entry.width;
  }
  const { cells, odd } = cellsOf(header, columns.get("cells")!, columns.get("odd")!);
  const harmonics = columns.get("harmonics");
  return {
    header,
    positions: positionsOf(header, columns.get("positions")!),
    cells,
    odd,
    values: valuesOf(columns),
    harmonics: harmonics ? harmonicsOf(harmonics) : null,
  };
}

interface Columns {
  entry: PackedArray;
  of: (column: number) => Int32Array;
}

function bytesOf(text: string): Uint8Array<ArrayBuffer> {
  const decode = (Uint8Array as unknown as { fromBase64?: (text: string) => Uint8Array<ArrayBuffer> }).fromBase64;
  if (decode) return decode(text);
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflated(bytes: Uint8Array<ArrayBuffer>): Promise<Uint8Array> {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser is too old to unpack the volume; this picture is all it can show.");
  }
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function columnOf(content: Uint8Array, entry: PackedArray, first: number, column: number): Int32Array {
  const { rows, width } = entry;
  const values = new Int32Array(rows);
  for (let byte = 0; byte < width; byte++) {
    const start = first + (column * width + byte) * rows;
    for (let i = 0; i < rows; i++) values[i] |= content[start + i] << (8 * byte);
  }
  if (entry.differences) {
    let sum = 0;
    for (let i = 0; i < rows; i++) {
      const step = values[i];
      sum += step & 1 ? -((step >>> 1) + 1) : step >>> 1;
      values[i] = sum;
    }
  }
  return values;
}

function positionsOf(header: Header, columns: Columns): Float32Array {
  const positions = new Float32Array(3 * header.vertices);
  const steps = 2 ** columns.entry.bits! - 1;
  for (let axis = 0; axis < 3; axis++) {
    const column = columns.of(axis);
    let highest = 0;
    for (const value of column) highest = Math.max(highest, value);
    for (let i = 0; i < column.length; i++) positions[3 * i + axis] = (column[i] - 0.5 * highest) / steps;
  }
  return positions;
}

function cellsOf(header: Header, steps: Columns, packed: Columns): { cells: Uint32Array; odd: Uint8Array } {
  const cells = new Uint32Array(4 * header.cells);
  const columns = [0, 1, 2, 3].map((k) => steps.of(k));
  const bits = packed.of(0);
  const odd = new Uint8Array(header.cells);
  let first = 0;
  let second = 0;
  for (let cell = 0; cell < header.cells; cell++) {
    const step = columns[0][cell];
    first += step;
    second = (step === 0 && cell > 0 ? second : first) + columns[1][cell];
    const third = second + columns[2][cell];
    cells.set([first, second, third, third + columns[3][cell]], 4 * cell);
    odd[cell] = (bits[cell >> 3] >> (cell & 7)) & 1;
  }
  return { cells, odd };
}

function valuesOf(columns: Map<string, Columns>): Float32Array<ArrayBuffer> {
  const scalar = columns.get("scalar");
  if (scalar) {
    const values = new Float32Array(4 * scalar.entry.rows);
    const steps = scalar.of(0);
    for (let i = 0; i < steps.length; i++) values[4 * i + 3] = scalar.entry.low! + scalar.entry.step! * steps[i];
    return values;
  }
  const density = columns.get("density")!;
  const color = columns.get("color")!;
  const values = new Float32Array(4 * density.entry.rows);
  const table = halves();
  [color.of(0), color.of(1), color.of(2), density.of(0)].forEach((column, channel) => {
    const dropped = (channel < 3 ? color : density).entry.dropped!;
    for (let i = 0; i < column.length; i++) values[4 * i + channel] = table[column[i] << dropped];
  });
  return values;
}

/** All half floats, by their bits. */
function halves(): Float32Array {
  const table = new Float32Array(1 << 16);
  for (let bits = 0; bits < table.length; bits++) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    const size = exponent === 0 ? fraction * 2 ** -24 : (1024 + fraction) * 2 ** (exponent - 25);
    table[bits] = bits & 0x8000 ? -size : size;
  }
  return table;
}

function harmonicsOf(columns: Columns): Harmonics {
  const { rows, columns: count, scale, degree } = columns.entry;
  const coefficients = new Float32Array(rows * count);
  for (let k = 0; k < count; k++) {
    const column = columns.of(k);
    for (let i = 0; i < rows; i++) coefficients[i * count + k] = (column[i] - 128) * scale![k];
  }
  return { degree: degree!, coefficients };
}
