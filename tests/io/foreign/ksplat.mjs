// Makes the .ksplat files of this folder with GaussianSplats3D 0.4.7, from a .ply (test_foreign_files.py says which):
//
//     cd web/tests && npm ci
//     node ../../tests/storage/foreign/ksplat.mjs in.ply
//
// Sections of 16 and 14 primitives (its writer needs sections of whole 4 bytes), blocks of half a unit, buckets of two.

import { readFileSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";

const found = createRequire(pathToFileURL(`${process.cwd()}/`)).resolve("@mkkellogg/gaussian-splats-3d");
const module = found.replace(/umd\.cjs$/, "module.js");
const { PlyParser, SplatBufferGenerator } = await import(pathToFileURL(module).href);
const bytes = readFileSync(process.argv[2]);
const input = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length);
for (const level of [0, 1, 2]) {
  for (const degree of [0, 1, 2]) {
    const splats = PlyParser.parseToUncompressedSplatArray(input, degree);
    const generator = SplatBufferGenerator.getStandardGenerator(1, level, 16, undefined, 0.5, 2);
    const { bufferData } = generator.generateFromUncompressedSplatArray(splats);
    writeFileSync(new URL(`level_${level}_degree_${degree}.ksplat`, import.meta.url), Buffer.from(bufferData));
  }
}
