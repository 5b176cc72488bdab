import { Publisher as PubSocket, Router } from "zeromq";
import type { Keys } from "./launch.js";
import { SOCKET_OPTIONS } from "./subscription.js";

/** Publishes this component's own messages, with times that increase strictly. */
export class Publisher {
  private readonly socket: PubSocket;
  private readonly bound: Promise<void>;
  private sending: Promise<void> = Promise.resolve();
  private newestNs = -1n;
  private guard: Router | undefined;

  constructor(address: string, keys: Keys | null) {
    const isEncrypted = keys?.everywhere ?? false;
    this.socket = new PubSocket({ ...SOCKET_OPTIONS, ...(isEncrypted && { curveServer: true, curveSecretKey: keys!.secret, zapDomain: "afspm" }) });
    this.bound = (isEncrypted ? this.letInPeers(keys!) : Promise.resolve()).then(() => this.socket.bind(address));
    this.bound.catch(() => undefined); // a publication is rejected with it
  }

  async publish(frames: (timeNs: bigint) => Uint8Array[], nowNs: bigint): Promise<void> {
    await this.bound;
    this.newestNs = nowNs > this.newestNs ? nowNs : this.newestNs + 1n;
    const packet = frames(this.newestNs);
    this.sending = this.sending.then(() => this.socket.send(packet));
    await this.sending;
  }

  async close(): Promise<void> {
    await this.bound.catch(() => undefined);
    await this.sending.catch(() => undefined);
    this.socket.close();
    this.guard?.close();
  }

  /** Answer ZeroMQ's authentication requests (RFC 27): accept the keys of the launch line. */
  private async letInPeers(keys: Keys): Promise<void> {
    const guard = (this.guard = new Router({ linger: 0 }));
    await guard.bind("inproc://zeromq.zap.01");
    void (async () => {
      for await (const [peer, delimiter, version, id, , , , , key] of guard) {
        const owner = key?.length === 32 ? keys.peers[z85(key)] : undefined;
        const verdict = owner === undefined ? ["400", "this key is not known", ""] : ["200", "", owner];
        await guard.send([peer!, delimiter!, version!, id!, ...verdict, ""]);
      }
    })();
  }
}

const Z85 = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ.-:+=^!/*?&<>()[]{}@%$#";

function z85(bytes: Buffer): string {
  let text = "";
  for (let at = 0; at < bytes.length; at += 4) {
    const number = bytes.readUInt32BE(at);
    for (let power = 85 ** 4; power >= 1; power /= 85) text += Z85[Math.floor(number / power) % 85];
  }
  return text;
}
