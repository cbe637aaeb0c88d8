// Lumps: the stiff parts of a scene, shown to an instructor, those that the result of an exercise reveals, and lumps that the user adds to
// an uploaded mesh.

import { create } from "@bufbuild/protobuf";
import type { Vec3 } from "palpate";
import { type Inclusion, InclusionSchema, type Scene, type Session } from "palpate/v1";
import type { Input } from "./input";
import { part } from "./page";
import { describe } from "./server";
import type { Stage } from "./stage";
import type { Place } from "./surface";
import type { ShownSession } from "./session";

/** A ball in the tissue. */
export interface Lump {
  centreM: Vec3;
  radiusM: number;
}

/**
 * Radius of an added lump, as a fraction of the tissue's size (9 mm in a liver), and its depth below the surface, as
 * a fraction of its radius.
 */
const RADIUS = 0.04;
const BENEATH = 0.4;
/** A lump blends into the tissue over this fraction of its radius. */
const EDGE = 0.4;
/** Stiffness factors of the lump and of what is beneath it, as in the scene `liver-organ`. */
const STIFFER = { springs: 1.5, support: 5 };
/** In a solid a lump is a ball of its own: how far beneath the surface its middle is, in radii, and how stiff. */
const IN_SOLID = { beneath: 1.3, factor: 5 };

/** Returns the lumps of a scene. Parts that are stiff by a group of the mesh have no shape of their own. */
function lumpsOf(scene: Scene | undefined): Lump[] {
  return (scene?.inclusions ?? []).flatMap(({ centreM, radiusM }) =>
    centreM ? [{ centreM: [centreM.x, centreM.y, centreM.z] as Vec3, radiusM: radiusM ?? 0 }] : [],
  );
}

/** Returns a lump beneath a place of the tissue. */
function lumpAt({ restM, outward }: Place, sizeM: number, edgeM: number, isSolid: boolean): Inclusion {
  // It must contain some vertices.
  const radiusM = Math.max(RADIUS * sizeM, 1.5 * edgeM);
  const beneathM = (isSolid ? IN_SOLID.beneath : BENEATH) * radiusM;
  const [x, y, z] = restM.map((v, c) => v - beneathM * outward[c]!) as Vec3;
  if (isSolid) return create(InclusionSchema, { centreM: { x, y, z }, radiusM, stiffnessFactor: IN_SOLID.factor });
  return create(InclusionSchema, {
    centreM: { x, y, z },
    radiusM,
    edgeM: EDGE * radiusM,
    stiffnessFactor: STIFFER.springs,
    anchorStiffnessFactor: STIFFER.support,
  });
}

/** What this module needs of the page. */
export interface Host {
  present: () => ShownSession | undefined;
  /** The scene that the page made from an uploaded mesh, if it shows one. */
  scene: () => Scene | undefined;
  /** Replaces the scene by another one of the same mesh. */
  exchange: (scene: Scene) => Promise<void>;
  notice: (text: string, seconds?: number) => void;
}

export class Lumps {
  private readonly box = part("lumps", HTMLInputElement);
  private readonly put = part("put-lump", HTMLButtonElement);
  private readonly take = part("take-lumps", HTMLButtonElement);
  /** The lumps of the shown session's scene. */
  private known: Lump[] = [];
  /** What was hidden, once a result tells it. It is shown until the instructor uses the box. */
  private revealed: readonly Lump[] | undefined;

  constructor(
    private readonly stage: Stage,
    private readonly input: Input,
    private readonly host: Host,
  ) {
    this.box.addEventListener("change", () => {
      this.revealed = undefined;
      this.draw();
    });
    this.put.addEventListener("click", () => this.place(this.input.onPlace === undefined));
    this.take.addEventListener("click", () => void this.change());
  }

  /** Shows the lumps of a session, if the instructor wants that, and the controls to change them. */
  show({ scene }: Session): void {
    this.revealed = undefined;
    this.known = lumpsOf(scene);
    part("own-lumps", HTMLElement).hidden = this.host.scene() === undefined;
    this.draw();
    if (this.input.onPlace) this.place(false);
  }

  /** Takes a new status of the session: a trainer may have hidden another lump. Lumps are only ever added to a session. */
  heard({ scene }: Session): void {
    const lumps = lumpsOf(scene);
    if (lumps.length === this.known.length) return;
    this.known = lumps;
    this.draw();
  }

  /** Shows what was hidden, whether the instructor wants that or not. */
  reveal(lumps: readonly Lump[]): void {
    this.revealed = lumps;
    this.draw();
  }

  private draw(): void {
    for (const each of [part("lumps-shown", HTMLElement), this.take]) each.hidden = this.known.length === 0;
    this.stage.setLumps(this.revealed ?? (this.box.checked ? this.known : []));
  }

  /** With `on`, the next press on the tissue adds a lump; otherwise presses touch again. */
  private place(on: boolean): void {
    this.put.setAttribute("aria-pressed", String(on));
    this.input.onPlace = on ? (place) => void this.change(place) : undefined;
    // On a phone the tissue is above the visible part of the page.
    if (on) part("view", HTMLElement).scrollIntoView({ block: "nearest" });
    this.host.notice(on ? "Press where the lump is to be." : "", 0);
  }

  /** Adds a lump beneath a place, or removes all lumps. */
  private async change(place?: Place): Promise<void> {
    this.place(false);
    const [scene, shownSession] = [this.host.scene(), this.host.present()];
    if (!scene || !shownSession) return;
    scene.inclusions = place ? [...scene.inclusions, lumpAt(place, shownSession.surface.sizeM, shownSession.edgeM, scene.solid !== undefined)] : [];
    try {
      // A user who adds a lump wants to see where it is.
      if (place) this.box.checked = true;
      await this.host.exchange(scene);
      if (place) this.host.notice("The lump is in. Take the tick from “Lumps” to hide it.", 8);
    } catch (error) {
      this.host.notice(`The lumps are as they were: ${describe(error)}.`);
    }
  }
}
