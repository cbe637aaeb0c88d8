// The picture: tissue, light, tools and camera. Drawn on changes, at most once per display frame.

import {
  AmbientLight,
  ArrowHelper,
  Color,
  CylinderGeometry,
  DirectionalLight,
  Group,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshPhongMaterial,
  MeshPhysicalMaterial,
  MeshStandardMaterial,
  MOUSE,
  PerspectiveCamera,
  Plane,
  PMREMGenerator,
  Raycaster,
  RingGeometry,
  Scene,
  SphereGeometry,
  SRGBColorSpace,
  ACESFilmicToneMapping,
  DoubleSide,
  MeshBasicMaterial,
  type Texture,
  TOUCH,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { RoomEnvironment } from "three/addons/environments/RoomEnvironment.js";
import { Effort, isDrawnBySoftware } from "./effort";
import type { Vec3 } from "./samples";
import type { Surface } from "./surface";

/** After this time without a frame, tool changes are drawn on their own. */
const ALONE_MS = 40;

/** A tool in the state of the server's sample. */
export interface ShownTool {
  placeM: Vec3;
  /** Force of the tissue on the tool. */
  forceN: Vec3;
}

export class Stage {
  readonly camera = new PerspectiveCamera(38, 1, 0.01, 10);
  /** Called after each picture. */
  onDrawn: () => void = () => {};
  /** Number of pictures drawn. */
  drawn = 0;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly orbit: OrbitControls;
  private readonly skin: MeshPhysicalMaterial;
  /** A simple material for the same tissue, at a tenth of the cost. */
  private readonly plain = new MeshPhongMaterial({ specular: 0x9a8f8c, shininess: 90, side: DoubleSide });
  private readonly hidden: MeshBasicMaterial;
  private readonly wires: LineBasicMaterial;
  private mesh: Mesh | undefined;
  private lines: LineSegments | undefined;
  private surface: Surface | undefined;
  private readonly marks: ToolMark[] = [];
  private readonly aim: Mesh;
  private extentM = new Vector2(1, 1);
  private wanted = false;
  private before = 0;
  private readonly effort: Effort;
  private wireframe = false;
  private held = false;
  /** A pending picture of tools, drawn if no frame causes one first. */
  private later: ReturnType<typeof setTimeout> | undefined;

  /** With `isFixed`, always uses the greatest effort, however long a picture takes. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    isFixed: boolean,
  ) {
    const isSoftware = isDrawnBySoftware();
    this.effort = new Effort(isSoftware, isFixed);
    // Smooth edges cost nothing with a graphics processor; without one, they cost several times everything else.
    this.renderer = new WebGLRenderer({ canvas, antialias: isFixed || !isSoftware });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.renderer.toneMapping = ACESFilmicToneMapping;
    const room = new PMREMGenerator(this.renderer);
    this.scene.environment = room.fromScene(new RoomEnvironment(), 0.04).texture;
    this.scene.environmentIntensity = 0.35;
    room.dispose();
    this.skin = new MeshPhysicalMaterial({
      roughness: 0.55,
      clearcoat: 0.9,
      clearcoatRoughness: 0.22,
      side: DoubleSide,
    });
    // Behind the lines of the mesh, the tissue hides the lines that are further away.
    this.hidden = new MeshBasicMaterial({ side: DoubleSide });
    for (const material of [this.skin, this.plain, this.hidden]) {
      material.polygonOffset = true;
      material.polygonOffsetFactor = 1;
      material.polygonOffsetUnits = 1;
    }
    this.wires = new LineBasicMaterial();
    // An endoscope's light is beside its lens.
    this.camera.up.set(0, 0, 1);
    const lamp = new DirectionalLight(0xfff3e6, 1.9);
    lamp.position.set(-0.35, 0.25, 0.3);
    this.camera.add(lamp, lamp.target);
    lamp.target.position.set(0, 0, -1);
    this.aim = new Mesh(new RingGeometry(0.8, 1, 32), new MeshBasicMaterial({ depthTest: false, transparent: true }));
    this.aim.renderOrder = 2;
    this.aim.visible = false;
    this.scene.add(this.camera, new AmbientLight(0xffffff, 0.25), this.aim);
    this.orbit = new OrbitControls(this.camera, canvas);
    // The left button and one finger control the tool.
    this.orbit.mouseButtons = { LEFT: null, MIDDLE: MOUSE.DOLLY, RIGHT: MOUSE.ROTATE };
    this.orbit.touches = { ONE: null, TWO: TOUCH.DOLLY_ROTATE };
    this.orbit.maxPolarAngle = 0.49 * Math.PI;
    this.orbit.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colours());
    this.colours();
  }

  /** Shows a surface of `extentM` metres. `keepView` keeps the camera. */
  show(surface: Surface, extentM: [number, number], texture: Texture | undefined, keepView: boolean): void {
    if (this.mesh && this.lines) this.scene.remove(this.mesh, this.lines);
    this.surface?.dispose();
    this.surface = surface;
    surface.drawEvery(this.effort.now.every);
    if (texture) {
      this.skin.map?.dispose();
      this.skin.map = this.skin.bumpMap = this.plain.map = texture;
      this.skin.needsUpdate = this.plain.needsUpdate = true;
    }
    this.mesh = new Mesh(surface.geometry, this.skin);
    this.lines = new LineSegments(surface.lines, this.wires);
    // Bounds of a moving surface are not worth computing.
    this.mesh.frustumCulled = this.lines.frustumCulled = false;
    this.scene.add(this.mesh, this.lines);
    this.extentM.set(...extentM);
    const size = this.extentM.length();
    this.skin.bumpScale = 1.2;
    this.camera.near = size / 200;
    this.camera.far = size * 20;
    this.orbit.minDistance = size / 8;
    this.orbit.maxDistance = size * 4;
    if (!keepView) {
      // Near parts look larger, so the picture's middle is slightly in front of the sheet's middle.
      const middle = new Vector3(extentM[0] / 2, 0.42 * extentM[1], -0.04 * size);
      this.orbit.target.copy(middle);
      this.camera.position.copy(middle).add(new Vector3(0, -0.86 * size, 0.66 * size));
    }
    this.camera.updateProjectionMatrix();
    this.orbit.update();
    this.setWireframe(this.wireframe);
  }

  setWireframe(on: boolean): void {
    this.wireframe = on;
    const skin = this.effort.now.isPhysical ? this.skin : this.plain;
    if (this.mesh) this.mesh.material = on ? this.hidden : skin;
    if (this.lines) this.lines.visible = on;
    this.draw();
  }

  setTools(tools: ShownTool[], mostN: number): void {
    const size = this.extentM.length();
    while (this.marks.length < tools.length) {
      const mark = new ToolMark();
      this.marks.push(mark);
      this.scene.add(mark.group);
    }
    this.marks.forEach((mark, index) => mark.show(this.held ? undefined : tools[index], size, mostN));
    // A tool's movement also moves tissue. A picture of the tool alone would only delay the one that shows both.
    this.later ??= setTimeout(() => this.draw(), ALONE_MS);
  }

  /** For measurements: hides everything but tissue, and makes each picture like the one before. */
  hold(on: boolean): void {
    this.held = on;
    if (on) for (const mark of this.marks) mark.group.visible = false;
  }

  /** Text for the status line: what is reduced in the picture. */
  describe(): string {
    return this.effort.describe(this.surface?.every ?? 1);
  }

  setAim(at: Vec3 | undefined): void {
    this.aim.visible = at !== undefined;
    if (at) this.aim.position.set(...at);
    this.aim.scale.setScalar(this.extentM.length() / 60);
    this.draw();
  }

  /** Turns the view by two angles and scales its distance. */
  turn(azimuth: number, polar: number, nearer: number): void {
    const offset = this.camera.position.clone().sub(this.orbit.target);
    const flat = Math.hypot(offset.x, offset.y);
    const about = Math.atan2(offset.y, offset.x) + azimuth;
    const up = Math.min(Math.max(Math.atan2(offset.z, flat) + polar, 0.05), 1.55);
    const far = offset.length() / nearer;
    const away = new Vector3(Math.cos(up) * Math.cos(about), Math.cos(up) * Math.sin(about), Math.sin(up));
    this.camera.position.copy(this.orbit.target).addScaledVector(away, far);
    this.orbit.update();
    this.draw();
  }

  private ray(x: number, y: number): Raycaster {
    const box = this.canvas.getBoundingClientRect();
    const caster = new Raycaster();
    const at = new Vector2((2 * (x - box.left)) / box.width - 1, 1 - (2 * (y - box.top)) / box.height);
    this.camera.updateMatrixWorld();
    caster.setFromCamera(at, this.camera);
    return caster;
  }

  /** The place in the rest plane whose tissue is under a point of the window; undefined beside the sheet. */
  pick(x: number, y: number): [number, number] | undefined {
    const surface = this.surface;
    if (!surface) return undefined;
    const { ray } = this.ray(x, y);
    const level = new Plane(new Vector3(0, 0, 1), 0);
    const hit = new Vector3();
    let moved: Vec3 = [0, 0, 0];
    // Intersect the ray with the level of the tissue found in the last round; dents are flat enough for a few rounds.
    for (let round = 0; round < 6; round++) {
      level.constant = -moved[2];
      if (!ray.intersectPlane(level, hit)) return undefined;
      moved = surface.displacementAtM(hit.x - moved[0], hit.y - moved[1]);
    }
    const [px, py] = [hit.x - moved[0], hit.y - moved[1]];
    const margin = 0.01 * this.extentM.length();
    const inside = px > -margin && py > -margin && px < this.extentM.x + margin && py < this.extentM.y + margin;
    const clamped = (v: number, most: number) => Math.min(Math.max(v, 0), most);
    return inside ? [clamped(px, this.extentM.x), clamped(py, this.extentM.y)] : undefined;
  }

  /** The place of a window point on the plane through `at` that faces the camera. */
  onFacingPlane(x: number, y: number, at: Vec3): Vec3 | undefined {
    const facing = this.camera.getWorldDirection(new Vector3());
    const plane = new Plane().setFromNormalAndCoplanarPoint(facing, new Vector3(...at));
    return this.ray(x, y).ray.intersectPlane(plane, new Vector3())?.toArray();
  }

  /** The window point of a place. */
  inWindow(at: Vec3): [number, number] {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const p = new Vector3(...at).project(this.camera);
    return [box.left + ((p.x + 1) / 2) * box.width, box.top + ((1 - p.y) / 2) * box.height];
  }

  /** The direction in the rest plane that points right in the window; one metre long. */
  rightwards(): [number, number] {
    const right = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const length = Math.hypot(right.x, right.y) || 1;
    return [right.x / length, right.y / length];
  }

  /** Requests a picture. */
  draw(): void {
    if (this.wanted) return;
    this.wanted = true;
    const askedMs = performance.now();
    requestAnimationFrame(() => this.drawNow(askedMs));
  }

  private drawNow(askedMs: number): void {
    this.wanted = false;
    clearTimeout(this.later);
    this.later = undefined;
    this.surface?.refresh();
    this.renderer.render(this.scene, this.camera);
    this.drawn += 1;
    this.onDrawn();
    // The browser may block the page until the picture is done, so measure its time afterwards.
    setTimeout(() => {
      const now = performance.now();
      // Only pictures that the page waited for count.
      const tookMs = now - Math.max(this.before, askedMs);
      this.before = now;
      this.adapt(tookMs);
    });
  }

  /** One pixel of the picture, right after drawing; waits for the graphics processor. */
  pixel(x: number, y: number): Uint8Array {
    const gl = this.renderer.getContext();
    const box = this.canvas.getBoundingClientRect();
    const of = [this.canvas.width / box.width, this.canvas.height / box.height] as const;
    const colour = new Uint8Array(4);
    gl.readPixels((x - box.left) * of[0], (box.bottom - y) * of[1], 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, colour);
    return colour;
  }

  /** Simpler pictures are better than fewer pictures. */
  private adapt(tookMs: number): void {
    if (this.held || !this.effort.tell(tookMs)) return;
    this.surface?.drawEvery(this.effort.now.every);
    this.setWireframe(this.wireframe);
    this.resize();
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2) * this.effort.now.pixels);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    // A narrow window also shows the whole sheet.
    this.camera.fov = width < height ? 38 * Math.min(height / width, 1.8) : 38;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  private colours(): void {
    const style = getComputedStyle(this.canvas.parentElement ?? this.canvas);
    this.scene.background = new Color(style.backgroundColor);
    this.hidden.color.set(style.backgroundColor);
    this.wires.color.set(style.color);
    (this.aim.material as MeshBasicMaterial).color.set(style.color);
    this.draw();
  }
}

/** A tool: its tip on the tissue, the force on it, and the mark of the contact. */
class ToolMark {
  readonly group = new Group();
  private readonly shaft: Mesh;
  private readonly ring: Mesh;
  private readonly arrow = new ArrowHelper(new Vector3(0, 0, 1), new Vector3(), 1, 0x2f9e6e);

  constructor() {
    const steel = new MeshStandardMaterial({ color: 0xc9ced6, metalness: 0.8, roughness: 0.35 });
    const rod = new CylinderGeometry(0.6, 0.6, 14, 16).rotateX(Math.PI / 2).translate(0, 0, 8);
    this.shaft = new Mesh(rod, steel);
    this.shaft.add(new Mesh(new SphereGeometry(1, 20, 14).translate(0, 0, 1), steel));
    this.ring = new Mesh(
      new RingGeometry(1.5, 1.9, 32),
      new MeshBasicMaterial({ color: 0x2f9e6e, depthTest: false, transparent: true, opacity: 0.8, side: DoubleSide }),
    );
    this.ring.renderOrder = 1;
    for (const part of [this.arrow.line, this.arrow.cone]) {
      const material = part.material as MeshBasicMaterial | LineBasicMaterial;
      material.depthTest = false;
      part.renderOrder = 1;
    }
    this.group.add(this.shaft, this.ring, this.arrow);
  }

  show(tool: ShownTool | undefined, size: number, mostN: number): void {
    this.group.visible = tool !== undefined;
    if (!tool) return;
    const force = new Vector3(...tool.forceN);
    const strength = force.length();
    this.group.position.set(...tool.placeM);
    this.shaft.scale.setScalar(size / 110);
    this.ring.scale.setScalar(size / 110);
    this.arrow.visible = this.ring.visible = strength > 1e-3 * mostN;
    if (!this.arrow.visible) return;
    // The tool approaches from the side and leans against the force on it. When the force pulls it, it does not turn
    // round.
    const axis = force.clone().normalize();
    if (axis.z < 0) axis.negate();
    axis.add(new Vector3(0.55, 0.2, 0)).normalize();
    if (axis.z > 0.2) this.shaft.quaternion.setFromUnitVectors(new Vector3(0, 0, 1), axis);
    const length = Math.min(strength / mostN, 1) * 0.28 * size + 0.03 * size;
    this.arrow.setDirection(force.normalize());
    this.arrow.setLength(length, 0.03 * size, 0.018 * size);
  }
}
