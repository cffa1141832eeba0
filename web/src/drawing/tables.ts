// What renderers keep of a volume: tables whose rows are read by their index.
import { hierarchyOf } from "../volume/hierarchy";
import type { Volume } from "../volume/payload";
import { topologyOf } from "../volume/topology";

/** Of each table, the type of its rows in WGSL. */
export const ROWS = {
  vertices: "vec4f", // positions, and density or scalar where these are the vertices'
  colors: "vec4f", // linear RGB, with density or scalar in w; of vertices or cells
  links: "vec2u", // 4 cell + rank: the cell behind that face, and its apex
  faces: "vec4u", // two rows for each boundary face, in the order of the hierarchy
  nodes: "vec4f", // two rows for each box of the hierarchy
  knots: "vec4f", // two rows for each knot of the transfer function: scalar; linear RGB and density
} as const;

export type TableName = keyof typeof ROWS;
export type Table = Float32Array<ArrayBuffer> | Uint32Array<ArrayBuffer>;

export type Tables = Partial<Record<TableName, Table>>;

/** Numbers in a row. */
export const channelsOf = (name: TableName): number => Number(ROWS[name][3]);

/** The tables that are the same in all pictures; the others are those of Frames. */
export function tablesOf({ header, positions, cells, odd, values }: Volume): Tables {
  const topology = topologyOf(cells, odd);
  const hierarchy = hierarchyOf(positions, topology.boundary);
  const vertices = new Float32Array(4 * header.vertices);
  for (let i = 0; i < header.vertices; i++) {
    vertices.set(positions.subarray(3 * i, 3 * i + 3), 4 * i);
    if (header.location === "vertex") vertices[4 * i + 3] = values[4 * i + 3];
  }
  return { vertices, links: topology.links, faces: hierarchy.faces, nodes: hierarchy.nodes };
}
