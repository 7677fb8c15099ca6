// Verdicts of the page's decoder, for the comparison with Python's: a JSON line for each path on stdin. A valid scene
// gives a digest of what both must decode to the bit: positions, cameras and weights.
//
//     node judge.mjs < PATHS

import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { PackError } from "../src/scene/container";
import { readScene, type Scene } from "../src/scene/scene";

function digestOf({ field, head, cameras }: Scene): string {
  const hash = createHash("sha256").update(field.means);
  for (const name of [...(head?.tensors.keys() ?? [])].sort()) hash.update(head!.tensors.get(name)!.values);
  for (const { pose, fx, fy, cx, cy, width, height } of cameras) {
    hash.update(new Float64Array([...pose, fx, fy, cx, cy, width, height]));
  }
  return hash.digest("hex");
}

for await (const path of createInterface({ input: process.stdin })) {
  let found: object;
  try {
    const scene = await readScene(new Uint8Array(readFileSync(path)));
    const { degree, logits, antialiased, background, trainedFocal, up, start } = scene;
    found = { digest: digestOf(scene), degree, logits, antialiased, background, trainedFocal, up, start };
  } catch (error) {
    found = error instanceof PackError ? { error: error.message } : { traceback: `${error}` };
  }
  console.log(JSON.stringify(found));
}
