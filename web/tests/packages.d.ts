// What the checks use of packages that are only installed for make browser.

declare module "webgpu" {
  export function create(options: string[]): GPU;
  export const globals: object;
}

declare module "@mkkellogg/gaussian-splats-3d" {
  export const SceneRevealMode: { Instant: number };
  export class Viewer {
    constructor(options: object);
    addSplatScene(address: string, options: object): Promise<void>;
    update(): void;
    render(): void;
  }
}

declare module "@sparkjsdev/spark" {
  import { Object3D, type WebGLRenderer } from "three";

  export class SparkRenderer extends Object3D {
    constructor(options: object & { renderer: WebGLRenderer });
  }
  export class SplatMesh extends Object3D {
    constructor(options: object & { url: string });
    readonly initialized: Promise<unknown>;
  }
}
