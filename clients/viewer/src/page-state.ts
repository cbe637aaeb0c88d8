// State of the page, for tests and measurements: `window.palpate`.

import { Burns, norm, vec } from "palpate";
import type { Comparison } from "./comparison";
import type { ExercisePanel } from "./exercise";
import type { Latency } from "./latency";
import { pictureFrom } from "./pictures";
import type { Player } from "./player";
import { received } from "./server";
import type { Sewing } from "./sewing";
import { Sheet } from "./sheet";
import type { Stage } from "./stage";
import type { ShownSession } from "./session";

/** The parts of the page that tell their state. */
interface Parts {
  stage: Stage;
  player: Player;
  latency: Latency;
  sewing: Sewing;
  exercise: ExercisePanel;
  comparison: Comparison;
}

/** The page's state as numbers, for tests and measurements. */
export function pageState(present: () => ShownSession | undefined, { stage, player, latency, sewing, exercise, comparison }: Parts) {
  return {
    /** The curves that are compared with the tissue. */
    get comparison() {
      return comparison.state;
    },
    get frames() {
      const { taken, skipped, newest } = present()?.frames ?? { taken: 0, skipped: 0n };
      return { taken, skipped: Number(skipped), drawn: stage.drawn, timeS: newest?.timeS ?? 0 };
    },
    get exercise() {
      return exercise.state;
    },
    /** Number of lumps that are drawn. */
    get lumps() {
      return stage.lumpCount;
    },
    get received() {
      return received.bytes;
    },
    get ageMs() {
      return present()?.frameAgeMs;
    },
    get picture() {
      return stage.describe();
    },
    get largestM() {
      return present()?.surface.largestM() ?? 0;
    },
    get forceN() {
      return present()?.samples.tools.map((tool) => norm(tool.forceN)) ?? [];
    },
    /** Forces on each tool of the chosen hand, by the newest sample. */
    get ownForcesN() {
      const { hand, samples } = present() ?? {};
      return (samples?.toolSamples ?? []).flatMap((tool) => (hand?.tool.has(tool.tool) ? [norm(vec(tool.forceOnToolN))] : []));
    },
    /** The hands: what each does, and the force on it; and the number of the chosen one. */
    get hands() {
      const { hands, samples } = present() ?? {};
      const both = (hands?.both ?? []).map(({ mode, touches, isParked, grasper, holds, tool }) => {
        const felt = holds ? samples?.tools.find((each) => each.tool === tool.tool) : undefined;
        return { mode, touches, isParked, grips: grasper.grips, forceN: felt ? norm(felt.forceN) : 0 };
      });
      return { both, chosen: hands?.number, isTwo: hands?.isTwo };
    },
    /** Simulated time of the newest sample, s. */
    get sampledS() {
      return present()?.samples.newest?.simulationTimeS ?? 0;
    },
    /** Largest displacement of the control point during the time span of the plots. */
    get deepestM() {
      return Math.max(0, ...(present()?.samples.history.map((moment) => norm(moment.displacementM)) ?? []));
    },
    /** What blades have cut, as the server tells it and as it is drawn. */
    get wound() {
      const { session, wound, surface } = present() ?? {};
      const { shown, waiting, cutFaces } = surface?.wound.count ?? { shown: 0, waiting: 0, cutFaces: 0 };
      return { cutFaces, severed: session?.severed ?? 0, pieces: session?.pieces ?? 0, version: wound?.version ?? 0, vertices: wound?.vertices.length ?? 0, shown, waiting, mostAtOnce: surface?.wound.mostAtOnce ?? 0 };
    },
    /** What tips have burnt, as it is drawn. */
    get burns() {
      const { version, burn } = present()?.burning.burns ?? new Burns(0);
      return { version, burnt: burn.filter((of) => of > 0).length, through: burn.filter((of) => of >= 1).length };
    },
    /** The longest times since the last look that the page has worked on a picture, and on a change of the wound, ms. */
    takeLongest(): { pictureMs: number; woundMs: number } {
      const session = present();
      const longest = { pictureMs: stage.takeLongestMs(), woundMs: session?.longestCutMs ?? 0 };
      if (session) session.longestCutMs = 0;
      return longest;
    },
    /** The threads and clips of the session, and how many places are picked for the next one. */
    get sewing() {
      const ties = (present()?.session.ties ?? []).map(({ tie, lengthM, pathM, tensionN, broken }) => {
        return { number: tie?.number ?? 0, kind: tie?.kind.case, lengthM, pathM, tensionN, broken };
      });
      return { ties, picked: sewing.picked };
    },
    get holds() {
      return present()?.hands.holding !== undefined;
    },
    /** The recording that is played, if any. */
    get recording() {
      return player.moment;
    },
    /** Position of the camera. */
    get camera() {
      return stage.camera.matrixWorld.toArray();
    },
    /**
     * Whether datagrams get through, and how many were sent and received in this session, with the number of poses
     * and samples in them.
     */
    get datagrams() {
      const { carries, counts } = (present()?.hands.holding ?? present()?.hand)?.tool.datagrams ?? {};
      return { carries: carries ?? false, sent: 0, came: 0, poses: 0, samples: 0, fellBack: 0, ...counts };
    },
    /**
     * Smallest distance between a tool and the tissue as drawn, as a fraction of the tissue's width; undefined
     * without a tool.
     */
    get clear() {
      const [{ clearM }, shownSession] = [stage, present()];
      return clearM === undefined || !shownSession ? undefined : clearM / shownSession.widthM;
    },
    /** Whether the first picture of the tissue was drawn, and had a texture; and whether it has one now. */
    get drawing() {
      return { ...stage.began, hasTexture: stage.isTextured };
    },
    /** The camera's height above the table and the tissue beneath it, as a fraction of the tissue's width. */
    get cameraHeight() {
      const shownSession = present();
      return shownSession ? stage.heightM / shownSession.widthM : 0;
    },
    /** Width of the tissue, m. */
    get widthM() {
      return present()?.widthM ?? 0;
    },
    /**
     * Window coordinates of the tissue at (x, y): fractions of a sheet; for a body, near this point of the picture.
     */
    at(x: number, y: number): [number, number] | undefined {
      const { surface } = present() ?? {};
      if (!surface) return undefined;
      const place = surface instanceof Sheet ? surface.placeAt(x, y) : stage.pickNear(x, 1 - y);
      return place && stage.placeInWindow(place);
    },
    /** A small picture of what is shown, for the list of scenes. */
    thumbnail(): string {
      let picture = "";
      stage.snap((drawn) => (picture = pictureFrom(drawn)));
      return picture;
    },
    pixelAfterPress: (x: number, y: number) => latency.next(x, y),
  };
}
