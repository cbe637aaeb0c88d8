// The picture: tissue, table, tools and camera. It is drawn when something changes, at most once per display frame.

import {
  Box3,
  Color,
  DoubleSide,
  LineBasicMaterial,
  LineSegments,
  Mesh,
  MeshBasicMaterial,
  MOUSE,
  PerspectiveCamera,
  Plane,
  Ray,
  Raycaster,
  Scene,
  SphereGeometry,
  SRGBColorSpace,
  type Texture,
  TOUCH,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { type ShownTie, TieMarks } from "./tie-marks";
import { BladeMark, isSameBlade, type ShownBlade } from "./blade-mark";
import { Body } from "./body";
import { Effort, isDrawnBySoftware } from "./effort";
import type { ShownGrasper, View } from "./grasper";
import { GrasperMark, isSamePose } from "./grasper-mark";
import { Ground } from "./ground";
import { defaultCameraOfBody, defaultCameraOfSheet } from "./default-camera";
import { CutSurfaceMaterial, light, Skin, SHADOWS, WoundInside } from "./material";
import { norm, type Vec3 } from "palpate";
import type { Lump } from "./lumps";
import type { Place, Surface } from "./surface";
import { type Seen, type ShownTool, ToolMark } from "./tool";

/** After this time without a frame, changes of the tools are drawn on their own. */
const ALONE_MS = 40;
/** After this time without a change, a picture that was drawn with reduced effort is drawn again in full. */
const CALM_MS = 450;
/** Resolution of that picture relative to the screen, without a graphics processor: more pixels smooth edges. */
const CALM_PIXELS = 1.5;
/** If that would take longer than this, normal resolution is used, because a press must not wait for it. */
const CALM_TAKES_MS = 500;
/** Movements of the tissue that are invisible, as a fraction of its size. */
const UNSEEN = 2e-5;
const FIELD_OF_VIEW = 28;
/** Corners of the ring at the pointer. */
const RING_POINTS = 32;
/** Minimum height of the camera above a sheet, as a fraction of its size. */
const MIN_HEIGHT = 0.06;
/**
 * Minimum distance of the camera from a closed body, and from the orbit target in an open one, as a fraction of the
 * body's size.
 */
const NEAREST = 0.05;
const AHEAD = 0.15;
/** The camera's range of polar angles about its target, measured from straight above: for a sheet, and for a body. */
const POLAR = { sheet: [0, 0.46 * Math.PI], body: [0.02, Math.PI - 0.02] } as const;
/** Position of the lamp of a body, relative to the eye: to the right, above and behind. */
const LAMP = [-0.66, 0.78, 0.34] as const;
/** Size of a projected texture on a body, m: at this size its details look natural. */
const PERIOD_M = 0.075;

export class Stage {
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 10);
  /** Called after each picture. */
  onDrawn: () => void = () => {};
  /** Number of pictures drawn. */
  drawn = 0;
  /** Increases whenever the view changes. */
  views = 0;
  /** Whether the tissue was ever drawn, and whether it then had its texture: for tests. */
  readonly began = { isDrawn: false, isTextured: false };
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly orbit: OrbitControls;
  /** Materials of sheets and of bodies. Each is compiled when it is first used. */
  private readonly skins = { sheet: new Skin(false), body: new Skin(true) };
  private skin = this.skins.sheet;
  private ground: Ground | undefined;
  private readonly colour = { table: new Color(), background: new Color() };
  private readonly hidden = new MeshBasicMaterial({ side: DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 });
  private readonly wires = new LineBasicMaterial();
  /** Shape of lumps, which are visible through the tissue. */
  private readonly ball = new SphereGeometry(1, 32, 24);
  private readonly lumpy = new MeshBasicMaterial({ color: 0x3d8bff, depthTest: false, transparent: true, opacity: 0.45 });
  private readonly marked = new MeshBasicMaterial({ color: 0xffb000, depthTest: false, transparent: true, opacity: 0.55 });
  private lumps: Mesh[] = [];
  private markedBalls: Mesh[] = [];
  private readonly inside = new WoundInside(0x5a0d10, 0);
  private readonly lip = new WoundInside(0x2e0608, 5e-4);
  private readonly cutSurface = new CutSurfaceMaterial();
  /** The parts of cut triangles, the tissue between the lips, the lines along these, and the surface within the cuts of a solid. */
  private wound: [Mesh, Mesh, LineSegments, Mesh] | undefined;
  private mesh: Mesh | undefined;
  private edge: Mesh | undefined;
  private lines: LineSegments | undefined;
  private surface: Surface | undefined;
  private readonly marks: ToolMark[] = [];
  private tools: ShownTool[] = [];
  /** This page has two hands. */
  private readonly grasperMarks = [new GrasperMark(), new GrasperMark()];
  private graspers: ShownGrasper[] = [];
  private readonly bladeMarks = [new BladeMark(), new BladeMark()];
  private blades: ShownBlade[] = [];
  private readonly tieMarks = new TieMarks();
  private aim: Place | undefined;
  /** Whether the camera is still in its initial position. */
  private isHome = true;
  /** Height of the covered area at the bottom of the picture, pixels. */
  private coveredPx = 0;
  private wanted = false;
  private before = 0;
  /** Time that the last picture with movement took, ms. */
  private tookMs = 0;
  /** The longest time that the page has worked on one picture, without the browser's drawing, ms. */
  private longestMs = 0;
  private readonly effort: Effort;
  private wireframe = false;
  private held = false;
  private isSoftware: boolean;
  private isFine = false;
  /** Whether more than the tissue changed since the last picture, and how far the tissue moved since, m. */
  private isDue = false;
  private unseenM = 0;
  /** A pending picture of the tools, if no frame causes one first; and a pending picture in full. */
  private later: ReturnType<typeof setTimeout> | undefined;
  private calm: ReturnType<typeof setTimeout> | undefined;
  private readonly spot = new Vector3();
  private readonly bounds = new Box3();
  private readonly seen: Seen = { eye: new Vector3(), right: new Vector3() };
  private readonly projected = new Vector3();

  /** With `isFixed`, always uses the greatest effort, however long a picture takes. */
  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly isFixed: boolean,
  ) {
    this.isSoftware = isDrawnBySoftware();
    this.effort = new Effort(this.isSoftware, isFixed);
    // Antialiasing costs nothing with a graphics processor; without one, it costs several times as much as everything
    // else.
    this.renderer = new WebGLRenderer({ canvas, antialias: isFixed || !this.isSoftware });
    this.renderer.outputColorSpace = SRGBColorSpace;
    this.camera.up.set(0, 0, 1);
    this.scene.add(this.camera, this.tieMarks.group, ...[...this.grasperMarks, ...this.bladeMarks].map(({ group }) => group));
    this.orbit = new OrbitControls(this.camera, canvas);
    // The left button and one finger control the tool.
    this.orbit.mouseButtons = { LEFT: null, MIDDLE: MOUSE.PAN, RIGHT: MOUSE.ROTATE };
    this.orbit.touches = { ONE: null, TWO: TOUCH.DOLLY_ROTATE };
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

  /**
   * Shows a surface. `keepView` keeps the camera and the texture; otherwise the whole tissue is shown above the
   * covered area.
   */
  show(surface: Surface, keepView: boolean, coveredPx = 0): void {
    if (!keepView) this.coveredPx = coveredPx;
    for (const old of [this.mesh, this.edge, this.lines, this.ground?.mesh, ...(this.wound ?? [])]) if (old) this.scene.remove(old);
    this.surface?.dispose();
    this.ground?.dispose();
    this.surface = surface;
    surface.drawEvery(this.effort.now.every);
    const isBody = surface instanceof Body;
    const skin = isBody ? this.skins.body : this.skins.sheet;
    if (!keepView || skin !== this.skin) this.skin.dropTexture();
    this.skin = skin;
    const size = surface.sizeM;
    if (isBody) {
      skin.uniforms.projected!.value = surface.isMapped ? 0 : 1;
      // A body whose size is not that of an organ gets equally many details.
      skin.uniforms.period!.value = size > 0.4 * PERIOD_M && size < 10 * PERIOD_M ? PERIOD_M : size / 3;
      skin.uniforms.reach!.value = size;
      skin.uniforms.closed!.value = surface.isOpen ? 0 : 1;
      surface.onLight = () => this.draw();
    }
    this.mesh = new Mesh(surface.geometry, skin);
    this.edge = surface.edge && new Mesh(surface.edge.geometry, skin);
    this.lines = new LineSegments(surface.lines, this.wires);
    const { parts, bed, lips, cutSurface } = surface.wound;
    this.wound = [new Mesh(parts, skin), new Mesh(bed, this.inside), new LineSegments(lips, this.lip), new Mesh(cutSurface, this.cutSurface)];
    this.cutSurface.follow(skin);
    this.ground = new Ground(surface, this.colour.table, this.colour.background);
    for (const part of [this.mesh, this.edge, this.lines, this.ground.mesh, ...this.wound]) {
      if (!part) continue;
      // Computing the bounds of a moving surface is not worthwhile.
      part.frustumCulled = false;
      this.scene.add(part);
    }
    this.camera.near = isBody ? size / 300 : size / 60;
    this.camera.far = size * 20;
    this.orbit.minDistance = isBody ? size / 40 : size / 4;
    this.orbit.maxDistance = size * 5;
    [this.orbit.minPolarAngle, this.orbit.maxPolarAngle] = POLAR[isBody ? "body" : "sheet"];
    this.orbit.screenSpacePanning = isBody;
    // Zooms towards the pointer.
    this.orbit.zoomToCursor = isBody;
    this.aim = undefined;
    if (!keepView) this.isHome = true;
    if (this.isHome) this.goHome();
    this.setWireframe(this.wireframe);
  }

  /** To be called when the tissue's texture arrives. */
  setTexture(texture: Texture): void {
    if (!this.isSoftware) texture.anisotropy = 8;
    this.skin.setTexture(texture);
    this.draw();
  }

  /** Returns the camera to its initial position. */
  resetView(): void {
    this.isHome = true;
    this.goHome();
  }

  /** Places the camera so that the whole tissue fills the picture. */
  private goHome(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const surface = this.surface;
    if (!surface || width === 0 || height === 0) return;
    const home = [this.camera, this.orbit.target, { width, height, coveredPx: this.coveredPx }] as const;
    if (surface instanceof Body) defaultCameraOfBody(surface, ...home);
    else defaultCameraOfSheet(surface, ...home);
    this.orbit.update();
    this.views += 1;
    this.draw();
  }

  setWireframe(on: boolean): void {
    this.wireframe = on;
    if (this.mesh) this.mesh.material = on ? this.hidden : this.skin;
    if (this.wound) {
      this.wound[0].material = on ? this.hidden : this.skin;
      this.wound[3].visible = !on;
    }
    if (this.lines) this.lines.visible = on;
    if (this.edge) this.edge.visible = !on;
    if (this.ground) this.ground.mesh.visible = !on;
    this.draw();
  }

  /** Shows lumps in the tissue. */
  setLumps(lumps: readonly Lump[]): void {
    this.lumps = this.exchange(this.lumps, lumps, this.lumpy);
  }

  /** Number of lumps that are shown. */
  get lumpCount(): number {
    return this.lumps.length;
  }

  /** Shows places that were marked. */
  setMarks(marks: readonly Lump[]): void {
    this.markedBalls = this.exchange(this.markedBalls, marks, this.marked);
  }

  /** Draws balls in place of others. */
  private exchange(former: readonly Mesh[], balls: readonly Lump[], material: MeshBasicMaterial): Mesh[] {
    for (const old of former) this.scene.remove(old);
    const meshes = balls.map(({ centreM, radiusM }) => {
      const ball = new Mesh(this.ball, material);
      ball.position.set(...centreM);
      ball.scale.setScalar(radiusM);
      ball.renderOrder = 1;
      this.scene.add(ball);
      return ball;
    });
    this.draw();
    return meshes;
  }

  /** Shows tools, and this page's own graspers and blades. */
  setTools(tools: ShownTool[], graspers: ShownGrasper[] = [], blades: ShownBlade[] = []): void {
    const isNear = ({ forceN, part }: { forceN: Vec3; part: number }, before: Vec3) => {
      const least = 2e-3 * (norm(forceN) / (part || 1));
      return forceN.every((v, c) => Math.abs(v - before[c]!) < least);
    };
    const isSame =
      blades.length === this.blades.length &&
      blades.every((blade, index) => isSameBlade(blade, this.blades[index]!)) &&
      graspers.length === this.graspers.length &&
      graspers.every((grasper, index) => {
        const old = this.graspers[index]!;
        return isSamePose(grasper.pose, old.pose) && isNear(grasper, old.forceN);
      }) &&
      tools.length === this.tools.length &&
      tools.every((tool, index) => {
        const old = this.tools[index]!;
        return tool.place.restM.every((v, c) => v === old.place.restM[c]) && isNear(tool, old.forceN);
      });
    if (isSame) return;
    [this.tools, this.graspers, this.blades] = [tools, graspers, blades];
    while (this.marks.length < tools.length) {
      const mark = new ToolMark();
      this.marks.push(mark);
      this.scene.add(mark.group);
    }
    // A tool's movement usually also moves tissue. A picture of the tool alone would only delay the one that shows
    // both.
    this.later ??= setTimeout(() => this.draw(), ALONE_MS);
  }

  /** Shows threads and clips, or those of before if `ties` is undefined, and the places that are picked for the next one. */
  setTies(ties: readonly ShownTie[] | undefined, picked: readonly Place[]): void {
    if (ties === undefined && picked === this.tieMarks.picked) return;
    this.tieMarks.ties = ties ?? this.tieMarks.ties;
    this.tieMarks.picked = picked;
    this.draw();
  }

  /** Places the tools on the tissue as it is drawn now. */
  private placeTools(): void {
    const surface = this.surface;
    this.seen.right.setFromMatrixColumn(this.camera.matrixWorld, 0);
    this.seen.eye.copy(this.camera.position);
    for (const shadowed of [...light.tips.value, ...light.rings.value]) shadowed.w = 0;
    this.grasperMarks.forEach((mark, index) => {
      const grasper = this.held ? undefined : this.graspers[index];
      if (grasper && surface) mark.show(grasper, surface, surface.sizeM, index);
      else mark.hide();
    });
    this.bladeMarks.forEach((mark, index) => {
      const blade = this.held ? undefined : this.blades[index];
      if (blade) mark.show(blade, this.graspers.length + index);
      else mark.hide();
    });
    this.marks.forEach((mark, index) => {
      const tool = this.held ? undefined : this.tools[index];
      if (tool && surface) mark.show(tool, surface, surface.sizeM, this.seen, this.graspers.length + this.blades.length + index);
      else mark.hide();
    });
    if (surface) this.tieMarks.place(surface);
    const ring = light.rings.value[SHADOWS]!;
    if (!this.aim || !surface || this.held) return;
    const at = this.spot.set(...this.aim.restM).add(surface.displacementAt(this.aim));
    ring.set(at.x, at.y, at.z, surface.sizeM / 42);
  }

  /** Returns the window position of a tool's tip; undefined if it is not drawn. */
  tipInWindow(number: number): [number, number] | undefined {
    const grasper = this.graspers.findIndex(({ tool }) => tool === number);
    if (grasper >= 0) return this.inWindow(this.grasperMarks[grasper]!.endsM.toArray());
    const blade = this.blades.findIndex(({ tool }) => tool === number);
    if (blade >= 0) return this.inWindow(this.bladeMarks[blade]!.tipM.toArray());
    const mark = this.marks[this.tools.findIndex(({ tool }) => tool === number)];
    return mark && this.inWindow(mark.tipM.toArray());
  }

  /** Smallest distance between a drawn tool and the drawn tissue, m; undefined without a tool. */
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

  /** Returns the number of window pixels for one metre, at the middle of the tissue. */
  pixelsPerMetre(): number {
    if (!this.surface) return NaN;
    const middle = this.surface.box.getCenter(new Vector3()).toArray();
    const step = 0.01 * this.surface.sizeM;
    const right = this.spot.setFromMatrixColumn(this.camera.matrixWorld, 0);
    const [rx, ry, rz] = [right.x, right.y, right.z];
    const [x0, y0] = this.inWindow([middle[0] - step * rx, middle[1] - step * ry, middle[2] - step * rz]);
    const [x1, y1] = this.inWindow([middle[0] + step * rx, middle[1] + step * ry, middle[2] + step * rz]);
    return Math.hypot(x1 - x0, y1 - y0) / (2 * step);
  }

  /** For measurements: hides everything except the tissue, and makes consecutive pictures identical. */
  hold(on: boolean): void {
    this.held = on;
  }

  /** Text for the status line: what is reduced in the picture. */
  describe(): string {
    return this.effort.describe(this.surface?.every ?? 1);
  }

  /** Marks the target of the keys. */
  setAim(place: Place | undefined): void {
    this.aim = place;
    this.draw();
  }

  /** Turns the view by two angles and scales its distance. */
  turn(azimuth: number, polar: number, nearer: number): void {
    const offset = this.camera.position.clone().sub(this.orbit.target);
    const flat = Math.hypot(offset.x, offset.y);
    const about = Math.atan2(offset.y, offset.x) + azimuth;
    const least = this.surface instanceof Body ? -1.55 : 0.13;
    const up = Math.min(Math.max(Math.atan2(offset.z, flat) + polar, least), 1.55);
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

  /** Returns the place of the tissue at a point of the window; undefined if there is none. */
  pick(x: number, y: number): Place | undefined {
    return this.surface?.pick(this.ray(x, y).ray);
  }

  /** Returns the place in the middle of the window, or the nearest one. */
  pickMiddle(): Place | undefined {
    return this.pickNear(0.5, 0.5);
  }

  /** Returns the place nearest to a point of the picture, which is given as fractions of its width and height. */
  pickNear(fx: number, fy: number): Place | undefined {
    const box = this.canvas.getBoundingClientRect();
    const step = Math.min(box.width, box.height) / 24;
    for (let ring = 0; ring < 24; ring++) {
      for (let k = 0; k < Math.max(1, 8 * ring); k++) {
        const angle = (k / Math.max(1, 8 * ring)) * 2 * Math.PI;
        const x = box.left + fx * box.width + ring * step * Math.cos(angle);
        const y = box.top + fy * box.height + ring * step * Math.sin(angle);
        const place = this.pick(x, y);
        if (place) return place;
      }
    }
    return undefined;
  }

  /** Sets whether a drag with the left button or one finger turns the view. */
  turnByDrag(on: boolean): void {
    this.orbit.mouseButtons.LEFT = on ? MOUSE.ROTATE : null;
    this.orbit.touches.ONE = on ? TOUCH.ROTATE : null;
  }

  /** Returns the point at a window position on the plane through `at` that faces the camera. */
  onFacingPlane(x: number, y: number, at: Vec3): Vec3 | undefined {
    const facing = this.camera.getWorldDirection(new Vector3());
    const plane = new Plane().setFromNormalAndCoplanarPoint(facing, new Vector3(...at));
    return this.ray(x, y).ray.intersectPlane(plane, new Vector3())?.toArray();
  }

  /** Returns the window position of a point. */
  inWindow(at: Vec3): [number, number] {
    const box = this.canvas.getBoundingClientRect();
    this.camera.updateMatrixWorld();
    const p = this.projected.set(...at).project(this.camera);
    return [box.left + ((p.x + 1) / 2) * box.width, box.top + ((1 - p.y) / 2) * box.height];
  }

  /** Returns a unit vector along the tissue at a place: `way` gives its components to the right and up, as seen. */
  across({ outward }: Place, way: [number, number]): Vector3 {
    const out = new Vector3(...outward);
    const right = new Vector3().setFromMatrixColumn(this.camera.matrixWorld, 0);
    right.addScaledVector(out, -right.dot(out));
    if (right.lengthSq() < 1e-6) right.set(1, 0, 0).addScaledVector(out, -out.x);
    right.normalize();
    return out.cross(right).multiplyScalar(way[1]).addScaledVector(right, way[0]);
  }

  /** Returns how the user sees a place. */
  viewOf(place: Place): View {
    const [right, up] = [this.across(place, [1, 0]), this.across(place, [0, 1])];
    const hasRoom = (shaft: Vec3, lengthM: number): boolean => {
      const { surface } = this;
      if (!surface) return true;
      const tipM = surface.displacementAt(place).clone().add(this.spot.set(...place.restM));
      const radiusM = 0.1 * lengthM;
      return surface.room(tipM.addScaledVector(new Vector3(...place.outward), radiusM), new Vector3(...shaft), lengthM, radiusM, 0.5) >= 0;
    };
    return { right: right.toArray(), up: up.toArray(), hasRoom };
  }

  /** Returns the present window position of a place. */
  placeInWindow(place: Place): [number, number] | undefined {
    if (!this.surface) return undefined;
    return this.inWindow(new Vector3(...place.restM).add(this.surface.displacementAt(place)).toArray());
  }

  /** Returns a ring on the tissue around a place, in window coordinates. */
  ringInWindow(place: Place, radiusM: number): [number, number][] {
    if (!this.surface) return [];
    const at = new Vector3(...place.restM).add(this.surface.displacementAt(place));
    const [right, ahead] = [this.across(place, [1, 0]), this.across(place, [0, 1])];
    return Array.from({ length: RING_POINTS }, (_, k) => {
      const angle = (2 * Math.PI * k) / RING_POINTS;
      const [x, y] = [radiusM * Math.cos(angle), radiusM * Math.sin(angle)];
      return this.inWindow(this.spot.copy(at).addScaledVector(right, x).addScaledVector(ahead, y).toArray());
    });
  }

  /** Requests a picture of a frame. If the frame moves nothing visibly, a picture that was drawn in full is kept. */
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

  /** Returns the longest time that the page has worked on one picture since the last call, ms. */
  takeLongestMs(): number {
    const { longestMs } = this;
    this.longestMs = 0;
    return longestMs;
  }

  private drawNow(askedMs: number): void {
    this.wanted = false;
    clearTimeout(this.later);
    this.later = undefined;
    const begunMs = performance.now();
    // The rest of a large wound comes with the next pictures.
    if (this.surface?.refresh()) requestAnimationFrame(() => this.draw());
    // The tissue between the lips stands for what is within the cut: a solid shows that.
    if (this.wound) this.wound[1].visible = !this.wireframe && this.surface?.wound.count.cutFaces === 0;
    this.unseenM += this.surface?.takeMoved() ?? 0;
    this.longestMs = Math.max(this.longestMs, performance.now() - begunMs);
    if (this.isFine && !this.isDue && !this.held && this.unseenM < UNSEEN * (this.surface?.sizeM ?? 1)) {
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
      // Only the time counts for which the page waited.
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

  /** Keeps the camera's target in the tissue, and the camera above a sheet and its table, and positions the lamp. */
  private stayAbove(): void {
    const surface = this.surface;
    if (!surface) return;
    const { position } = this.camera;
    const { target } = this.orbit;
    if (surface.edge) {
      target.x = Math.min(Math.max(target.x, surface.box.min.x), surface.box.max.x);
      target.y = Math.min(Math.max(target.y, surface.box.min.y), surface.box.max.y);
      const floor = Math.max(surface.heightAt(position.x, position.y) ?? 0, 0) + MIN_HEIGHT * surface.sizeM;
      if (position.z < floor) {
        position.z = floor;
        this.camera.lookAt(target);
      }
      this.camera.updateMatrixWorld();
      // From the left and behind the tissue, as seen: dents then show their dark side, and the far side is bright.
      const ahead = this.spot.copy(target).sub(position).setZ(0).normalize();
      light.lamp.value.set(0.5 * ahead.x - 0.62 * ahead.y, 0.5 * ahead.y + 0.62 * ahead.x, 0.98).normalize();
      return;
    }
    if (surface.isOpen) this.goIn(surface, target);
    else this.stayOutside(surface);
    this.camera.updateMatrixWorld();
    // Over the left shoulder, whatever the view.
    const lamp = light.lamp.value.set(0, 0, 0);
    LAMP.forEach((part, column) => lamp.addScaledVector(this.spot.setFromMatrixColumn(this.camera.matrixWorld, column), part));
    lamp.normalize();
  }

  /** Lets the camera enter an open body: the orbit target stays ahead of it. */
  private goIn(surface: Surface, target: Vector3): void {
    const { position } = this.camera;
    const ahead = this.spot.copy(target).sub(position);
    const least = AHEAD * surface.sizeM;
    if (ahead.length() < least) target.copy(position).addScaledVector(ahead.normalize(), least);
    this.bounds.copy(surface.box).expandByScalar(0.2 * surface.sizeM).clampPoint(target, target);
  }

  /** Keeps the camera outside a closed body. */
  private stayOutside(surface: Surface): void {
    const { position } = this.camera;
    surface.box.clampPoint(this.orbit.target, this.orbit.target);
    const ahead = this.camera.getWorldDirection(new Vector3());
    const toEye = new Ray(position, ahead);
    const hit = surface.pick(toEye);
    if (!hit) return;
    const at = surface.displacementAt(hit).add(this.spot.set(...hit.restM));
    const apart = at.distanceTo(position);
    const normal = surface.outerAt(hit);
    const least = NEAREST * surface.sizeM;
    // The camera sees an inner side, or is about to.
    if (normal.dot(ahead) > 0) {
      const back = surface.pick(new Ray(position.clone(), ahead.clone().negate()));
      const out = back ? surface.displacementAt(back).add(this.spot.set(...back.restM)).distanceTo(position) : 0;
      position.addScaledVector(ahead, -out - least);
    } else if (apart < least) {
      position.addScaledVector(ahead, apart - least);
    }
  }

  /** Whether the camera is in its initial position. */
  get isAtHome(): boolean {
    return this.isHome;
  }

  /** Calls `take` with the next picture directly after drawing it, when it can be read. */
  snap(take: (drawn: HTMLCanvasElement) => void): void {
    this.paint();
    take(this.canvas);
  }

  /** Draws a picture without movement again, with all pixels and antialiasing. */
  private paintInFull(): void {
    if (this.held || this.wanted || document.hidden) return;
    this.fit(true);
    this.paint();
  }

  /** Returns one pixel of the picture, directly after drawing; waits for the graphics processor. */
  pixel(x: number, y: number): Uint8Array {
    const gl = this.renderer.getContext();
    const box = this.canvas.getBoundingClientRect();
    const of = [this.canvas.width / box.width, this.canvas.height / box.height] as const;
    const colour = new Uint8Array(4);
    gl.readPixels((x - box.left) * of[0], (box.bottom - y) * of[1], 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, colour);
    return colour;
  }

  /** Adapts the effort: simpler pictures are better than fewer pictures. */
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

  /** Sets the number of pixels: as many as time permits, or all. */
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
    this.colour.background.copy(background);
    this.colour.table.set(style.getPropertyValue("--table").trim() || style.backgroundColor);
    this.ground?.colours(this.colour.table, this.colour.background);
    light.ink.value.set(0xfff4ec);
    this.draw();
  }
}
