// Parts of the page that need no browser: the views that addresses name, and the resolution after frames of some times.
//
//     node page.mjs '{"addresses": ["#camera=2"], "stops": 3, "frames": [[20, 4]]}'
//
// Frames have a time in milliseconds at full resolution, and one that does not depend on it.

import { linked, linkTo, type Place } from "../src/page/link";
import { Pace } from "../src/page/pace";

type Task = { addresses: string[]; stops: number; places: [number | null, Place][]; frames: [number, number][] };

const { addresses, stops, places, frames } = JSON.parse(process.argv[2]!) as Task;
const pace = new Pace();
const shares = frames.map(([scaled, fixed]) => {
  const { share } = pace;
  pace.learn(scaled * share ** 2 + fixed);
  return share;
});
const links = places.map(([stop, place]) => linkTo(stop, place));
console.log(JSON.stringify({ views: addresses.map((address) => linked(address, stops)), links, shares }));
