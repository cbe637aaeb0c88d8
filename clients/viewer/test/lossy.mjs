// A network in front of a server, in which datagrams can be cut.

import { createSocket } from "node:dgram";
import { once } from "node:events";
import { connect, createServer } from "node:net";

/** Passes TCP and UDP on between a port of its own and a server's; each client of UDP by a socket of its own. */
export class Lossy {
  isCut = false;
  /** The server's port. */
  to = 0;
  /** @type {Map<number, import("node:dgram").Socket>} */
  clients = new Map();

  static async open() {
    for (;;) {
      const calls = createServer().listen(0, "127.0.0.1").unref();
      await once(calls, "listening");
      const { port } = /** @type {import("node:net").AddressInfo} */ (calls.address());
      const datagrams = createSocket("udp4").unref();
      datagrams.bind(port, "127.0.0.1");
      try {
        await once(datagrams, "listening");
        return new Lossy(port, calls, datagrams);
      } catch {
        // Another process uses the UDP port of that number.
        calls.close();
      }
    }
  }

  /**
   * @param {number} port
   * @param {import("node:net").Server} calls
   * @param {import("node:dgram").Socket} datagrams
   */
  constructor(port, calls, datagrams) {
    this.port = port;
    this.calls = calls;
    this.datagrams = datagrams;
    calls.on("connection", (client) => {
      const server = connect(this.to, "127.0.0.1");
      client.pipe(server).pipe(client);
      client.on("error", () => server.destroy());
      server.on("error", () => client.destroy());
    });
    datagrams.on("message", (packet, client) => {
      if (!this.isCut) this.client(client.port).send(packet, this.to, "127.0.0.1");
    });
  }

  /** The socket of the client at a port. @param {number} port */
  client(port) {
    const known = this.clients.get(port);
    if (known) return known;
    const made = createSocket("udp4").unref();
    made.on("message", (packet) => {
      if (!this.isCut) this.datagrams.send(packet, port, "127.0.0.1");
    });
    this.clients.set(port, made);
    return made;
  }

  close() {
    this.calls.close();
    for (const socket of [this.datagrams, ...this.clients.values()]) socket.close();
  }
}
