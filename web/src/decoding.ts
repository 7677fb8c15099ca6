// Decoding in a worker, so that no file can freeze the page.

import { PackError } from "./scene/container";
import { readScene, type Scene } from "./scene/scene";

/** A scene of a million primitives takes a few seconds. */
const MOST_SECONDS = 120;

type Answer = { scene: Scene } | { error: string } | { share: number };

/** What runs in the worker: answers one file with shares of the work, then with its scene or an error message. */
export function answer(): void {
  self.onmessage = async ({ data }: MessageEvent<Uint8Array<ArrayBuffer>>) => {
    try {
      const scene = await readScene(data, (share) => self.postMessage({ share }));
      // Arrays are moved, not copied: a phone may lack the memory for two scenes.
      const buffers = Object.values(scene.field).flatMap((value) => (typeof value === "number" ? [] : [value.buffer]));
      self.postMessage({ scene }, { transfer: [...new Set(buffers)] });
    } catch (error) {
      self.postMessage({
        error: error instanceof PackError ? error.message : `The scene cannot be decoded (${error}).`,
      });
    }
  };
}

/** Decodes a file in a worker that runs the page's own program; throws a PackError that says what is wrong. */
export function decode(
  file: Uint8Array<ArrayBuffer>,
  program: string,
  onProgress: (share: number) => void,
): Promise<Scene> {
  const address = URL.createObjectURL(new Blob([program], { type: "text/javascript" }));
  const worker = new Worker(address);
  const result = new Promise<Scene>((resolve, reject) => {
    const fail = (message: string) => reject(new PackError(message));
    const timer = setTimeout(() => fail(`The scene took more than ${MOST_SECONDS} s to decode.`), 1000 * MOST_SECONDS);
    worker.onmessage = ({ data }: MessageEvent<Answer>) => {
      if ("share" in data) {
        onProgress(data.share);
        return;
      }
      clearTimeout(timer);
      if ("scene" in data) resolve(data.scene);
      else fail(data.error);
    };
    worker.onerror = (event) => fail(`The scene cannot be decoded (${event.message}).`);
  });
  worker.postMessage(file, [file.buffer]);
  return result.finally(() => {
    worker.terminate();
    URL.revokeObjectURL(address);
  });
}
