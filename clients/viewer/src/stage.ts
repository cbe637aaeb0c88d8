// The picture: tissue, table, tools and camera. Drawn on changes, at most once per display frame.

import {
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  MOUSE,
  PerspectiveCamera,
  Plane,
  Raycaster,
  Scene,
  SRGBColorSpace,
  type Texture,
  TOUCH,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { Effort, isDrawnBySoftware } from "./effort";
import { light, Skin, SHADOWS, Table } from "./material";
import type { Vec3 } from "./samples";
import type { Surface } from "./surface";
import { type ShownTool, ToolMark } from "./tool";

/** After this time without a frame, tool changes are drawn on their own. */
const ALONE_MS = 40;
/** After this time without a change, a picture of less effort is drawn again in full. */
const CALM_MS = 450;
/** Pixels a side of that for each pixel of the screen, without a graphics processor: it smooths edges. */
const CALM_PIXELS = 1.5;
/** If that would take longer, one has to do: a press must not wait for it. */
const CALM_TAKES_MS = 500;
/** Movements of the tissue that nobody sees, of its size. */
const UNSEEN = 2e-5;
const FIELD_OF_VIEW = 28;
/** The tissue fills the picture up to these margins, pixels: the words at the top and the bottom stay free. */
const MARGIN = { top: 14, bottom: 46, side: 12 };
/** Least height of the camera above the tissue, of its size. */
const LEAST_HEIGHT = 0.06;

export class Stage {
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 10);
  /** Called after each picture. */
  onDrawn: () => void = () => {};
  /** Number of pictures drawn. */
  drawn = 0;
  /** Grows whenever the view changes. */
  views = 0;
  /** Whether the tissue was ever drawn, and whether its texture was then there: for tests. */
  readonly began = { isDrawn: false, isTextured: false };
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly orbit: OrbitControls;
  private readonly skin = new Skin();
  private readonly cloth = new Table();
  private readonly hidden = new MeshBasicMaterial({ side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
  private readonly wires = new LineBasicMaterial();
  private mesh: Mesh | undefined;
  private flank: Mesh | undefined;
  private lines: LineSegments | undefined;
  private table: Mesh | undefined;
  private surface: Surface | undefined;
  private readonly marks: ToolMark[] = [];
  private tools: ShownTool[] = [];
  private mostN = 1;
  private aimM: [number, number] | undefined;
  private extentM = new Vector2(1, 1);
  /** Whether the camera is where the page put it. */
  private isHome = true;
  private wanted = false;
  private before = 0;
  /** Time that the last picture of what moves took, ms. */
  private tookMs = 0;
  private readonly effort: Effort;
  private wireframe = false;
  private held = false;
  private isSoftware: boolean;
  private isFine = false;
  /** Whether more than the tissue changed since the last picture; and how far it moved since, m. */
  private isDue = false;
  private unseenM = 0;
  /** A pending picture of tools, drawn if no frame causes one first; and one in full. */
  private later: ReturnType<typeof setTimeout> | undefined;
  private calm: ReturnType<typeof setTimeout> | undefined;
  private readonly spot = new Vector3();
  private readonly projected = new Vector3();

  /** With `isFixed`, always uses the greatest effort, however long a picture takes. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly isFixed: boolean,
  ) {
    this.isSoftware = isDrawnBySoftware();
    this.effort = new Effort(this.isSoftware, isFixed);
    // Smooth edges cost nothing with a graphics processor; without one, they cost several times everything else.
    this.renderer = new WebGLRenderer({ canvas, antialias: isFixed || !this.isSoftware });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.camera.up.set(0, 0, 1);
    this.scene.add(this.camera);
    this.orbit = new OrbitControls(this.camera, canvas);
    // The left button and one finger control the tool.
    this.orbit.mouseButtons = { LEFT: null, MIDDLE: MOUSE.DOLLY, RIGHT: MOUSE.ROTATE };
    this.orbit.touches = { ONE: null, TWO: TOUCH.DOLLY_ROTATE };
    this.orbit.maxPolarAngle = 0.46 * Math.PI;
    this.orbit.screenSpacePanning = false;
    this.orbit.addEventListener("start", () => (this.isHome = false));
    this.orbit.addEventListener("change", () => {
      this.views += 1;
      this.draw();
    });
    canvas.addEventListener("wheel", () => (this.isHome = false), { passive: true });
    new ResizeObserver(() => this.resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colours());
    this.colours();
  }

  /** Shows a surface of `extentM` metres. `keepView` keeps the camera and the texture. */
  show(surface: Surface, extentM: [number, number], keepView: boolean): void {
    for (const old of [this.mesh, this.flank, this.lines, this.table]) if (old) this.scene.remove(old);
    this.surface?.dispose();
    this.table?.geometry.dispose();
    this.surface = surface;
    surface.drawEvery(this.effort.now.every);
    if (!keepView) this.skin.dropTexture();
    this.mesh = new Mesh(surface.geometry, this.skin);
    this.flank = new Mesh(surface.flank.geometry, this.skin);
    this.lines = new LineSegments(surface.lines, this.wires);
    this.extentM.set(...extentM);
    const size = this.extentM.length();
    this.table = new Mesh(tableGeometry(extentM, surface.flank.roundM, surface.flank.heightM, 8 * size), this.cloth);
    const { middle, half_, height } = this.cloth.uniforms as Record<string, { value: unknown }>;
    (middle!.value as Vector2).set(extentM[0] / 2, extentM[1] / 2);
    (half_!.value as Vector2).set(extentM[0] / 2, extentM[1] / 2).addScalar(0.6 * surface.flank.roundM);
    height!.value = surface.flank.heightM;
    // Bounds of a moving surface are not worth computing.
    for (const part of [this.mesh, this.flank, this.lines, this.table]) part.frustumCulled = false;
    this.scene.add(this.mesh, this.flank, this.lines, this.table);
    this.camera.near = size / 60;
    this.camera.far = size * 20;
    this.orbit.minDistance = size / 4;
    this.orbit.maxDistance = size * 5;
    if (!keepView) this.isHome = true;
    if (this.isHome) this.goHome();
    this.setWireframe(this.wireframe);
  }

  /** The tissue's texture has arrived. */
  setTexture(texture: Texture): void {
    if (!this.isSoftware) texture.anisotropy = 8;
    this.skin.setTexture(texture);
    this.draw();
  }

  /** Puts the camera where the whole tissue fills the picture: lower in a wide one, higher in a narrow one. */
  private goHome(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const surface = this.surface;
    if (!surface || width === 0 || height === 0) return;
    const [w, l] = [this.extentM.x, this.extentM.y];
    const { roundM, heightM } = surface.flank;
    const aspect = (width - 2 * MARGIN.side) / Math.max(height - MARGIN.top - MARGIN.bottom, 1);
    const elevation = Math.asin(Math.min(Math.max((0.98 * w) / Math.max(l, 1e-9) / aspect, 0.64), 0.9));
    const target = this.orbit.target.set(w / 2, l / 2, 0);
    const away = new Vector3(0, -Math.cos(elevation), Math.sin(elevation));
    const tangent = Math.tan(((FIELD_OF_VIEW / 2) * Math.PI) / 180);
    const part = { x: 1 - (2 * MARGIN.side) / width, y: 1 - (MARGIN.top + MARGIN.bottom) / height };
    let distance = 3 * Math.max(w, l);
    let [low, high] = [0, 0];
    for (let round = 0; round < 12; round++) {
      let widest = 0;
      [low, high] = [Infinity, -Infinity];
      for (const x of [-roundM - w / 2, w / 2 + roundM]) {
        for (const [y, z] of [[-l / 2 - roundM, -roundM], [-l / 2 - roundM, -heightM], [l / 2 + roundM, 0]] as const) {
          const depth = distance - (y * away.y + z * away.z);
          const up = (y * Math.sin(elevation) + z * Math.cos(elevation)) / depth / tangent;
          low = Math.min(low, up);
          high = Math.max(high, up);
          widest = Math.max(widest, (Math.abs(x) / depth / tangent) * (height / width));
        }
      }
      distance *= Math.max(widest / part.x, (high - low) / 2 / part.y);
    }
    this.camera.position.copy(target).addScaledVector(away, distance);
    // The middle of what is seen goes to the middle of what is free.
    const lift = (MARGIN.bottom - MARGIN.top) / 2 - ((low + high) / 2) * (height / 2);
    this.camera.setViewOffset(width, height, 0, lift, width, height);
    this.camera.updateProjectionMatrix();
    this.orbit.update();
    this.views += 1;
    this.draw();
  }

  setWireframe(on: boolean): void {
    this.wireframe = on;
    if (this.mesh) this.mesh.material = on ? this.hidden : this.skin;
    if (this.lines) this.lines.visible = on;
    if (this.flank) this.flank.visible = !on;
    if (this.table) this.table.visible = !on;
    this.draw();
  }

  setTools(tools: ShownTool[], mostN: number): void {
    this.mostN = mostN;
    const least = 2e-3 * mostN;
    const isSame =
      tools.length === this.tools.length &&
      tools.every(({ restM, forceN }, index) => {
        const old = this.tools[index]!;
        return restM.every((v, c) => v === old.restM[c]) && forceN.every((v, c) => Math.abs(v - old.forceN[c]!) < least);
      });
    if (isSame) return;
    this.tools = tools;
    while (this.marks.length < tools.length) {
      const mark = new ToolMark(this.marks.length);
      this.marks.push(mark);
      this.scene.add(mark.group);
    }
    // A tool's movement also moves tissue. A picture of the tool alone would only delay the one that shows both.
    this.later ??= setTimeout(() => this.draw(), ALONE_MS);
  }

  /** Puts the tools on the tissue as it is drawn now. */
  private placeTools(): void {
    const size = this.extentM.length();
    this.spot.setFromMatrixColumn(this.camera.matrixWorld, 0);
    for (let index = 0; index < this.marks.length; index++) {
      const tool = this.held || !this.surface ? undefined : this.tools[index];
      if (tool) this.marks[index]!.show(tool, this.surface!, size, this.mostN, this.spot);
      else this.marks[index]!.hide();
    }
    const aim = light.rings.value[SHADOWS]!;
    aim.w = 0;
    if (!this.aimM || !this.surface || this.held) return;
    const moved = this.surface.displacementAt(...this.aimM);
    aim.set(this.aimM[0] + moved.x, this.aimM[1] + moved.y, moved.z, size / 42);
  }

  /** The first tool's tip in the window; undefined if there is none. */
  tipInWindow(): [number, number] | undefined {
    return this.tools.length > 0 && this.marks[0] ? this.inWindow(this.marks[0].tipM.toArray()) : undefined;
  }

  /** The least room between a drawn tool and the drawn tissue, m; undefined without a tool. */
  get clearM(): number | undefined {
    if (!this.surface || this.tools.length === 0) return undefined;
    return Math.min(...this.marks.slice(0, this.tools.length).map((mark) => mark.clearM));
  }

  /** Height of the camera above the tissue beneath it, m. */
  get heightM(): number {
    const { x, y, z } = this.camera.position;
    return z - Math.max(this.surface?.heightAt(x, y) ?? 0, 0);
  }

  /** Whether the tissue is drawn with its texture. */
  get isTextured(): boolean {
    return this.skin.uniforms.mapped!.value === 1;
  }

  /** Pixels of the window for a metre across, at the middle of the tissue. */
  pixelsPerMetre(): number {
    const middle: Vec3 = [this.extentM.x / 2, this.extentM.y / 2, 0];
    const step = 0.01 * this.extentM.length();
    const right = this.spot.setFromMatrixColumn(this.camera.matrixWorld, 0);
    const [rx, ry, rz] = [right.x, right.y, right.z];
    const [x0, y0] = this.inWindow([middle[0] - step * rx, middle[1] - step * ry, middle[2] - step * rz]);
    const [x1, y1] = this.inWindow([middle[0] + step * rx, middle[1] + step * ry, middle[2] + step * rz]);
    return Math.hypot(x1 - x0, y1 - y0) / (2 * step);
  }

  /** For measurements: hides everything but tissue, and makes each picture like the one before. */
  hold(on: boolean): void {
    this.held = on;
  }

  /** Text for the status line: what is reduced in the picture. */
  describe(): string {
    return this.effort.describe(this.surface?.every ?? 1);
  }

  /** Marks a place in the rest plane, where the keys aim. */
  setAim(atM: [number, number] | undefined): void {
    this.aimM = atM;
    this.draw();
  }

  /** Turns the view by two angles and scales its distance. */
  turn(azimuth: number, polar: number, nearer: number): void {
    const offset = this.camera.position.clone().sub(this.orbit.target);
    const flat = Math.hypot(offset.x, offset.y);
    const about = Math.atan2(offset.y, offset.x) + azimuth;
    const up = Math.min(Math.max(Math.atan2(offset.z, flat) + polar, 0.13), 1.55);
    const far = offset.length() / nearer;
    const away = new Vector3(Math.cos(up) * Math.cos(about), Math.cos(up) * Math.sin(about), Math.sin(up));
    this.camera.position.copy(this.orbit.target).addScaledVector(away, far);
    this.isHome = false;
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
    const p = this.projected.set(...at).project(this.camera);
    return [box.left + ((p.x + 1) / 2) * box.width, box.top + ((1 - p.y) / 2) * box.height];
  }

  /** The direction in the rest plane that points right in the window; one metre long. */
  rightwards(): [number, number] {
    const right = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    const length = Math.hypot(right.x, right.y) || 1;
    return [right.x / length, right.y / length];
  }

  /** Requests a picture of a frame. One that moves nothing visibly is not worth drawing what stands there in full again. */
  drawFrame(): void {
    const wasDue = this.isDue;
    this.draw();
    this.isDue = wasDue;
  }

  /** Requests a picture. */
  draw(): void {
    this.isDue = true;
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
    this.unseenM += this.surface?.takeMoved() ?? 0;
    if (this.isFine && !this.isDue && !this.held && this.unseenM < UNSEEN * this.extentM.length()) {
      this.drawn += 1;
      return;
    }
    this.isDue = false;
    clearTimeout(this.calm);
    if (this.isFine) this.fit(false);
    this.paint();
    this.drawn += 1;
    if (this.mesh && !this.began.isDrawn) Object.assign(this.began, { isDrawn: true, isTextured: this.isTextured });
    this.onDrawn();
    // The browser may block the page until the picture is done, so measure its time afterwards.
    setTimeout(() => {
      const now = performance.now();
      // Only pictures that the page waited for count.
      const tookMs = now - Math.max(this.before, askedMs);
      this.before = now;
      if (!this.isFine) this.tookMs = tookMs;
      this.adapt(tookMs);
      clearTimeout(this.calm);
      const isLess = this.effort.now.pixels < 1 || (this.isSoftware && !this.isFixed);
      if (isLess) this.calm = setTimeout(() => this.paintInFull(), CALM_MS);
    });
  }

  private paint(): void {
    this.surface?.refresh();
    this.surface?.takeMoved();
    this.unseenM = 0;
    this.stayAbove();
    this.placeTools();
    this.renderer.render(this.scene, this.camera);
  }

  /** Keeps the camera above the tissue and the table, and its target in the tissue; and the lamp to the left behind it. */
  private stayAbove(): void {
    const { position } = this.camera;
    const { target } = this.orbit;
    const size = this.extentM.length();
    target.x = Math.min(Math.max(target.x, 0), this.extentM.x);
    target.y = Math.min(Math.max(target.y, 0), this.extentM.y);
    const floor = Math.max(this.surface?.heightAt(position.x, position.y) ?? 0, 0) + LEAST_HEIGHT * size;
    if (position.z < floor) {
      position.z = floor;
      this.camera.lookAt(target);
    }
    this.camera.updateMatrixWorld();
    // From the left and behind the tissue, as seen: dents turn a dark flank to the eye, and the far ones shine.
    const ahead = this.spot.copy(target).sub(position).setZ(0).normalize();
    light.lamp.value.set(0.5 * ahead.x - 0.62 * ahead.y, 0.5 * ahead.y + 0.62 * ahead.x, 0.98).normalize();
  }

  /** Draws again what stands still, with all pixels and smooth edges. */
  private paintInFull(): void {
    if (this.held || this.wanted || document.hidden) return;
    this.fit(true);
    this.paint();
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
    this.fit(false);
    this.camera.aspect = width / height;
    this.camera.setViewOffset(width, height, 0, this.camera.view?.offsetY ?? 0, width, height);
    this.camera.updateProjectionMatrix();
    this.views += 1;
    if (this.isHome) this.goHome();
    this.draw();
  }

  /** Sets the number of pixels: as many as there is time for, or all. */
  private fit(isFine: boolean): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = Math.min(devicePixelRatio, 2);
    const takesMs = this.tookMs * ((CALM_PIXELS / ratio / this.effort.now.pixels) ** 2);
    const fine = this.isSoftware && takesMs < CALM_TAKES_MS ? Math.max(ratio, CALM_PIXELS) : ratio;
    this.isFine = isFine;
    this.renderer.setPixelRatio(isFine ? fine : ratio * this.effort.now.pixels);
    this.renderer.setSize(width, height, false);
  }

  private colours(): void {
    const style = getComputedStyle(this.canvas.parentElement ?? this.canvas);
    const background = new Color(style.backgroundColor);
    this.scene.background = background;
    this.hidden.color.copy(background);
    this.wires.color.set(style.color);
    (this.cloth.uniforms.background!.value as Color).copy(background);
    (this.cloth.uniforms.colour!.value as Color).set(style.getPropertyValue("--table").trim() || style.backgroundColor);
    light.ink.value.set(0xfff4ec);
    this.draw();
  }
}

/** The table, with a hole beneath the tissue: a dent may reach below it. */
function tableGeometry([width, length]: [number, number], roundM: number, heightM: number, farM: number): BufferGeometry {
  const places: number[] = [];
  const corners = [[0, 0], [width, 0], [width, length], [0, length]] as const;
  const segments = 8;
  for (let corner = 0; corner <= 4; corner++) {
    const [x, y] = corners[corner % 4]!;
    for (let k = 0; k <= segments; k++) {
      const angle = Math.PI + (corner % 4) * (Math.PI / 2) + (k / segments) * (Math.PI / 2);
      const [ox, oy] = [Math.cos(angle), Math.sin(angle)];
      places.push(x + 0.5 * roundM * ox, y + 0.5 * roundM * oy, -heightM, x + farM * ox, y + farM * oy, -heightM);
    }
  }
  const triangles: number[] = [];
  for (let i = 0; i + 3 < places.length / 3; i += 2) triangles.push(i, i + 1, i + 3, i, i + 3, i + 2);
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(places), 3));
  geometry.setIndex(triangles);
  return geometry;
}
