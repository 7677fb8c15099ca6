// The camera of the page: orbit and fly by mouse, touch and keys, and the capture's cameras as stops.

import { Matrix4, PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { Camera, Scene } from "../scene/scene";
import { middleOf, reachOf } from "../scene/size";
import { type View, viewOf } from "../view";
import { linked, linkTo, type Place, resized } from "./link";

/** Keys that move the camera, by its own axes: right, up, backwards. */
const MOVES: Record<string, [number, number, number]> = {
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyE: [0, 1, 0],
  KeyQ: [0, -1, 0],
  KeyW: [0, 0, -1],
  KeyS: [0, 0, 1],
};
/** Keys that turn the camera: around the scene, or in fly mode in place; left and up. */
const TURNS: Record<string, [number, number]> = {
  ArrowLeft: [1, 0],
  ArrowRight: [-1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};
/** In fly mode the camera turns around a point this near, in units of the distance to the middle of the scene. */
const NEAR_TARGET = 1e-3;
/** Share of the distance to the middle of the scene that a key moves in a second. */
const SPEED = 0.5;
/** Angle that a key turns in a second, radian. */
const TURN_SPEED = 1;
const DEFAULT_FOV = 50;
/** Seconds between two places of a path, and most places of one that nobody has named. */
const LEG = 4;
const MOST_PLACES = 8;

/** A camera in front of a scene without cameras and start view: with z upwards it looks along y. */
function outside(scene: Scene, middle: Vector3): Camera {
  const up = new Vector3(...(scene.up ?? [0, 0, 1])).normalize();
  const side = new Vector3(...(Math.abs(up.x) < 0.9 ? [1, 0, 0] : [0, 1, 0]));
  const back = side.cross(up).normalize();
  const pose = new Matrix4()
    .makeBasis(up.clone().cross(back), up, back)
    .setPosition(back.multiplyScalar(3 * reachOf(scene)).add(middle));
  return { pose: pose.transpose().elements.slice(0, 12), fx: 500, fy: 500, cx: 320, cy: 240, width: 640, height: 480 };
}

/** Whether two poses are one, up to rounding. */
const isNear = (one: Camera, other: Camera): boolean =>
  one.pose.every((value, i) => Math.abs(value - other.pose[i]!) <= 1e-5 * Math.max(Math.abs(value), 1));

export class Navigation {
  readonly stops: Camera[];
  /** Index of the stop that is shown; null once the camera has moved. */
  stop: number | null = null;
  /** Index of the last stop. */
  visited = 0;
  private readonly camera = new PerspectiveCamera(DEFAULT_FOV, 1, 1e-3, 1e6);
  private readonly controls: OrbitControls;
  private readonly middle: Vector3;
  private readonly pressed = new Set<string>();
  private flying = false;
  private lastMove = 0;
  private lens: Camera;
  /** A closed path that plays, and the time in seconds since its first place. */
  private path: Place[] = [];
  private played = 0;

  /** Called when the camera has moved. */
  onChange = (): void => {};

  /**
   * @param element - takes mouse and touch
   * @param unit - world units in one unit of the scene; links have world units
   */
  constructor(
    scene: Scene,
    element: HTMLElement,
    private readonly unit: number,
  ) {
    this.middle = new Vector3(...middleOf(scene));
    this.stops = scene.cameras.length ? scene.cameras : [scene.start ?? outside(scene, this.middle)];
    this.lens = this.stops[0]!;
    this.camera.up.copy(scene.up ? new Vector3(...scene.up).normalize() : this.up());
    this.controls = new OrbitControls(this.camera, element);
    this.controls.addEventListener("change", () => this.onChange());
    this.controls.addEventListener("start", () => this.leave());
    window.addEventListener("keydown", (event) => this.press(event));
    window.addEventListener("keyup", (event) => this.pressed.delete(event.code));
    window.addEventListener("blur", () => this.pressed.clear());
    const start = scene.start ?? this.stops[0]!;
    const index = this.stops.findIndex((stop) => isNear(stop, start));
    this.open(start, index);
  }

  /** The mean of the upward directions of the stops. */
  private up(): Vector3 {
    const sum = new Vector3();
    for (const { pose } of this.stops) sum.add(new Vector3(pose[1], pose[5], pose[9]));
    return sum.lengthSq() > 1e-6 ? sum.normalize() : new Vector3(0, 0, 1);
  }

  /** Goes to a camera of the capture. */
  visit(index: number): void {
    this.open(this.stops[index]!, index);
  }

  /** Goes to a camera and the stop that it is; -1 for none. */
  private open(camera: Camera, index: number): void {
    const matrix = new Matrix4().fromArray([...camera.pose, 0, 0, 0, 1]).transpose(); // rows to columns
    matrix.decompose(this.camera.position, this.camera.quaternion, new Vector3());
    this.lens = camera;
    this.path = [];
    this.stop = index < 0 ? null : index;
    if (index >= 0) this.visited = index;
    this.aim();
    this.onChange();
  }

  /** The part of an address that names what the camera sees. */
  link(): string {
    const { position } = this.camera;
    const ahead = this.controls.target.clone().sub(position);
    const place = { position: position.toArray(), ahead: ahead.toArray(), lens: this.visited };
    return linkTo(this.stop, resized(place, this.unit));
  }

  /** The stop or the place that a part of an address names; null for none. */
  private linked(hash: string): number | Place | null {
    const found = linked(hash, this.stops.length);
    return typeof found === "object" && found ? resized(found, 1 / this.unit) : found;
  }

  /** Goes to the view that a part of an address names; stays where it names none. */
  follow(hash: string): void {
    const found = this.linked(hash);
    if (found === null) return;
    if (typeof found === "number") {
      this.visit(found);
      return;
    }
    this.path = [];
    this.go(found);
    this.aim();
    this.onChange();
  }

  private go({ position, ahead, lens }: Place): void {
    this.visited = lens;
    this.lens = this.stops[lens]!;
    this.stop = null;
    this.camera.position.fromArray(position);
    this.controls.target.fromArray(ahead).add(this.camera.position);
    this.controls.update();
  }

  get playing(): boolean {
    return this.path.length > 0;
  }

  /** Plays a closed path through the places of links, else through stops, else around the middle; stops one that plays. */
  play(links: string[]): void {
    if (this.playing) {
      this.path = [];
      this.onChange();
      return;
    }
    const named = links.map((hash) => this.linked(hash)).filter((found) => found !== null);
    const places = named.map((found) => (typeof found === "number" ? this.placeOf(found) : found));
    this.path = places.length > 1 ? places : this.stops.length > 2 ? this.tour() : this.circle();
    this.played = 0;
    this.lastMove = performance.now();
    this.onChange();
  }

  /** The place of a stop, which looks as far ahead as the middle of the scene is. */
  private placeOf(lens: number): Place {
    const { pose } = this.stops[lens]!;
    const position = new Vector3(pose[3], pose[7], pose[11]);
    const away = Math.max(position.distanceTo(this.middle), 1e-6);
    const ahead = new Vector3(-pose[2]!, -pose[6]!, -pose[10]!).multiplyScalar(away);
    return { position: position.toArray(), ahead: ahead.toArray(), lens };
  }

  /** Some stops, from the present one on always to the nearest that is left. */
  private tour(): Place[] {
    const stride = Math.ceil(this.stops.length / MOST_PLACES);
    const left = this.stops.map((_, i) => i).filter((i) => (i - this.visited) % stride === 0);
    const places = left.splice(left.indexOf(this.visited), 1).map((i) => this.placeOf(i));
    const point = (place: Place): Vector3 => new Vector3(...place.position);
    while (left.length) {
      const here = point(places.at(-1)!);
      const apart = left.map((i) => point(this.placeOf(i)).distanceTo(here));
      places.push(this.placeOf(left.splice(apart.indexOf(Math.min(...apart)), 1)[0]!));
    }
    return places;
  }

  /** Places around the middle of the scene, as high and as far as the camera is. */
  private circle(): Place[] {
    const arm = this.camera.position.clone().sub(this.middle);
    return Array.from({ length: MOST_PLACES }, (_, i) => {
      const turned = arm.clone().applyAxisAngle(this.camera.up, (2 * Math.PI * i) / MOST_PLACES);
      const position = turned.clone().add(this.middle).toArray();
      return { position, ahead: turned.negate().toArray(), lens: this.visited };
    });
  }

  /** The place on the path at the present time, on a smooth curve (Catmull and Rom). */
  private along(): Place {
    const { path } = this;
    const leg = Math.floor(this.played / LEG);
    const t = this.played / LEG - leg;
    const weights = [t * (t * (2 - t) - 1), t * t * (3 * t - 5) + 2, t * (t * (4 - 3 * t) + 1), t * t * (t - 1)];
    const near = weights.map((weight, i) => ({ weight, place: path[(leg + i + path.length - 1) % path.length]! }));
    const mix = (of: "position" | "ahead"): [number, number, number] =>
      [0, 1, 2].map((axis) => near.reduce((sum, { weight, place }) => sum + (weight / 2) * place[of][axis]!, 0)) as [
        number,
        number,
        number,
      ];
    return { position: mix("position"), ahead: mix("ahead"), lens: near[1]!.place.lens };
  }

  /** Leaves a stop or a path: from now on the controls hold the camera. */
  private leave(): void {
    this.path = [];
    if (this.stop === null) return;
    this.stop = null;
    this.controls.update();
  }

  private get distance(): number {
    return Math.max(this.camera.position.distanceTo(this.middle), 1e-6);
  }

  /** Puts the point that the controls turn around straight ahead of the camera. */
  private aim(): void {
    const ahead = this.camera.getWorldDirection(new Vector3());
    const depth = this.middle.clone().sub(this.camera.position).dot(ahead);
    const away = this.flying ? NEAR_TARGET * this.distance : Math.max(depth, 0.1 * this.distance);
    this.controls.target.copy(this.camera.position).addScaledVector(ahead, away);
  }

  get fly(): boolean {
    return this.flying;
  }

  set fly(on: boolean) {
    this.flying = on;
    this.aim();
    this.controls.enableZoom = this.controls.enablePan = !on;
    // A drag moves the scene in orbit mode and turns the head in fly mode.
    this.controls.rotateSpeed = on ? -0.4 : 1;
  }

  private press(event: KeyboardEvent): void {
    if (!(event.code in MOVES || event.code in TURNS) || event.ctrlKey || event.metaKey || event.altKey) return;
    // Arrows also move the slider.
    if (event.target instanceof HTMLInputElement && event.target.type === "range") return;
    this.pressed.add(event.code);
    this.leave();
    this.onChange();
  }

  /** Moves along the path or by the pressed keys; returns whether the camera is still moving. */
  move(now: number): boolean {
    const seconds = Math.max(now - this.lastMove, 0) / 1000;
    this.lastMove = now;
    if (this.playing) {
      this.played += seconds;
      this.go(this.along());
      return true;
    }
    if (this.pressed.size === 0) return false;
    this.moveBy(Math.min(seconds, 0.1));
    return true;
  }

  private moveBy(seconds: number): void {
    const step = new Vector3();
    for (const code of this.pressed) {
      step.add(new Vector3(...(MOVES[code] ?? [0, 0, 0])));
      const [left, up] = TURNS[code] ?? [0, 0];
      const angle = (this.flying ? -TURN_SPEED : TURN_SPEED) * seconds;
      if (left) this.controls.rotateLeft(left * angle);
      if (up) this.controls.rotateUp(up * angle);
    }
    step.applyQuaternion(this.camera.quaternion).multiplyScalar(SPEED * this.distance * seconds);
    this.camera.position.add(step);
    this.controls.target.add(step);
    this.controls.update();
  }

  /** The view of a canvas of some size, which shows at least what the camera of the last stop sees. */
  view(width: number, height: number): View {
    const { fx, fy, cx, cy } = this.lens;
    const scale = Math.min(width / this.lens.width, height / this.lens.height);
    this.camera.updateMatrixWorld();
    const rows = new Matrix4().copy(this.camera.matrixWorld).transpose().elements;
    const pose = this.stop === null ? rows.slice(0, 12) : this.stops[this.stop]!.pose;
    const [x, y] = [cx - this.lens.width / 2, cy - this.lens.height / 2];
    const centre = { cx: width / 2 + scale * x, cy: height / 2 + scale * y };
    return viewOf({ pose, fx: fx * scale, fy: fy * scale, ...centre, width, height });
  }
}
