// WGSL as it is written here in GLSL: types come before names there, and numbers have other names for their types.
//
// Here means: types of all variables are stated, blocks stand in braces, nothing is a pointer. What does not keep to
// this, compilers of GLSL refuse, as tests would show.

const NUMBERS: Record<string, string> = { f: "", i: "i", u: "u" };
const TYPES: Record<string, string> = { f32: "float", i32: "int", u32: "uint" };

/** What translated programs call that GLSL does not have. */
export const GLSL_PRELUDE = ["float", "int"]
  .map((type) => `${type} select(${type} no, ${type} yes, bool which) { return which ? yes : no; }`)
  .join("\n");

export function glslOf(wgsl: string): string {
  return wgsl
    .replace(/\/\/.*/g, "")
    .replace(/\bvec([234])([fiu])\b/g, (_, size: string, kind: string) => `${NUMBERS[kind]}vec${size}`)
    .replace(/\b[fiu]32\b/g, (type) => TYPES[type])
    .replace(/\bfn (\w+)\((.*?)\) -> (\w+)/g, (_, name: string, parameters: string, type: string) => {
      return `${type} ${name}(${parameters.replace(/(\w+): (\w+)/g, "$2 $1")})`;
    })
    .replace(/\bstruct \w+ \{[^}]*\}/g, (struct) => `${struct.replace(/(\w+): (\w+),/g, "$2 $1;")};`)
    .replace(/\bconst (\w+): (\w+)/g, "const $2 $1")
    .replace(/\b(?:let|var) (\w+): (\w+)/g, "$2 $1");
}
