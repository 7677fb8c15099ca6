// What the fallback without WebGPU finds of the first camera of packed scenes before it draws: a JSON line for each file.
//
//     node overdraw.mjs FILE...

import { readFileSync } from "node:fs";
import { geometryOf } from "../src/arrays";
import { mostPairs } from "../src/limits";
import { readScene } from "../src/scene/scene";
import { enlarged, unitOf } from "../src/scene/size";
import { viewOf } from "../src/view";
import { boundOf, extentsOf, fragmentsOf } from "../src/webgl/overdraw";

for (const file of process.argv.slice(2)) {
  const found = await readScene(new Uint8Array(readFileSync(file)));
  const scene = enlarged(found, unitOf(found));
  const [geometry, view] = [geometryOf(scene), viewOf(scene.cameras[0]!)];
  const bound = boundOf(geometry, extentsOf(geometry), view);
  const most = mostPairs((view.width * view.height) / 256, scene.field.count);
  console.log(JSON.stringify({ fragments: fragmentsOf(geometry, view), bound, most }));
}
