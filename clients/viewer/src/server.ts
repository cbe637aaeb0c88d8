// The server that the page came from, called with the caller's token.

import { Server } from "palpate";

export const server = new Server(location.origin);
export const { sessions, haptics, received } = server;

export { backoffMs, describe, type Failure, isGone, isPassing, isUnimplemented, keepOpen, CALL_TIMEOUT_MS, reasonOf, sleep } from "palpate";
