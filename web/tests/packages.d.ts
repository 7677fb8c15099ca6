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

declare module "playcanvas" {
  export const SHADERLANGUAGE_GLSL: string;
  export const ShaderChunks: {
    get(device: object, language: string): { get(name: string): string; set(name: string, text: string): void };
  };
  export const FILLMODE_NONE: string;
  export const RESOLUTION_FIXED: string;
  export class Color {
    constructor(r: number, g: number, b: number);
  }
  export class Mat4 {
    set(columns: number[]): this;
  }
  export class Quat {
    setFromMat4(matrix: Mat4): this;
  }
  export class Asset {
    constructor(name: string, type: string, file: { url: string });
    readonly resource: { instantiateRenderEntity(): Entity };
    on(event: string, call: (found: string) => void): void;
  }
  export class Entity {
    readonly camera: { calculateProjection: (matrix: Mat4) => void };
    addComponent(name: string, options: object): void;
    addChild(entity: Entity): void;
    setPosition(x: number, y: number, z: number): void;
    setRotation(turn: Quat): void;
  }
  export class Application {
    constructor(canvas: HTMLCanvasElement, options: object);
    readonly graphicsDevice: object;
    readonly root: Entity;
    readonly scene: { gsplat: object };
    readonly assets: { add(asset: Asset): void; load(asset: Asset): void };
    setCanvasFillMode(mode: string, width: number, height: number): void;
    setCanvasResolution(mode: string, width: number, height: number): void;
    start(): void;
    requestAnimationFrame: () => void;
    tick(time: number): void;
    destroy(): void;
  }
}

declare module "@babylonjs/loaders/glTF/2.0";
declare module "@babylonjs/loaders/SPLAT";

declare module "@babylonjs/core/Maths/math.color" {
  export class Color4 {
    constructor(r: number, g: number, b: number, a: number);
  }
}

declare module "@babylonjs/core/Maths/math.vector" {
  export class Vector3 {
    static Zero(): Vector3;
    setAll(value: number): void;
  }
  export class Matrix {
    static Identity(): Matrix;
    static FromArray(values: number[]): Matrix;
    invert(): Matrix;
    decomposeToTransformNode(node: object): void;
  }
}

declare module "@babylonjs/core/Engines/engine" {
  export class Engine {
    constructor(canvas: HTMLCanvasElement, antialias: boolean, options: object);
    dispose(): void;
  }
}

declare module "@babylonjs/core/scene" {
  export class Scene {
    constructor(engine: object);
    useRightHandedSystem: boolean;
    clearColor: object;
    render(): void;
  }
}

declare module "@babylonjs/core/Cameras/freeCamera" {
  import type { Matrix, Vector3 } from "@babylonjs/core/Maths/math.vector";

  export class FreeCamera {
    constructor(name: string, place: Vector3, scene: object);
    freezeProjectionMatrix(projection: Matrix): void;
  }
}

declare module "@babylonjs/core/Meshes/transformNode" {
  export class TransformNode {
    constructor(name: string, scene: object);
  }
}

declare module "@babylonjs/core/Materials/GaussianSplatting/gaussianSplattingMaterial" {
  export const GaussianSplattingMaterial: object;
}

declare module "@babylonjs/core/Loading/sceneLoader" {
  import type { Vector3 } from "@babylonjs/core/Maths/math.vector";

  export function ImportMeshAsync(
    address: string,
    scene: object,
    options: object,
  ): Promise<{ meshes: { parent: object | null; scaling: Vector3 }[] }>;
}
