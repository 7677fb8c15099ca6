// Decodes packed scenes, for the comparison with Python's decoder: prints a JSON line for each file, and writes the
// arrays of a valid one beside it as raw numbers; at most MOST Gaussians of each, as on a phone.
//
//     MOST=1000 node dump.mjs FILE...

import { readFileSync, writeFileSync } from "node:fs";
import { thinned } from "../src/page/budget";
import { PackError } from "../src/scene/container";
import { readScene } from "../src/scene/scene";

for (const file of process.argv.slice(2)) {
  try {
    const scene = await readScene(new Uint8Array(readFileSync(file)));
    const { field, head, ...rest } = thinned(scene, Number(process.env.MOST ?? Number.POSITIVE_INFINITY));
    const { count, ...arrays } = field;
    const tensors = [...(head?.tensors ?? [])].map(([name, tensor]) => [name, tensor.values] as const);
    for (const [name, values] of [...Object.entries(arrays), ...tensors]) writeFileSync(`${file}.${name}`, values);
    console.log(JSON.stringify({ count, head: head?.kind ?? null, ...rest }));
  } catch (error) {
    if (!(error instanceof PackError)) throw error;
    console.log(JSON.stringify({ error: error.message }));
  }
}
