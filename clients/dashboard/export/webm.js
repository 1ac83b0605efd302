/** Films of the stage: frames drawn one by one, encoded by the browser, put into a WebM file. */

const IDS = {
  header: 0x1a45dfa3, version: 0x4286, readVersion: 0x42f7, idLength: 0x42f2, sizeLength: 0x42f3,
  docType: 0x4282, docVersion: 0x4287, docReadVersion: 0x4285, segment: 0x18538067,
  info: 0x1549a966, scale: 0x2ad7b1, duration: 0x4489, muxer: 0x4d80, writer: 0x5741,
  tracks: 0x1654ae6b, track: 0xae, number: 0xd7, uid: 0x73c5, type: 0x83, codec: 0x86,
  video: 0xe0, width: 0xb0, height: 0xba, cluster: 0x1f43b675, time: 0xe7, block: 0xa3,
};

function idBytes(id) {
  const bytes = [];
  for (let rest = id; rest > 0; rest = Math.floor(rest / 256)) bytes.unshift(rest % 256);
  return bytes;
}

function element(id, ...parts) {
  const body = parts.map((part) => {
    if (part instanceof Uint8Array) return part;
    if (typeof part === 'string') return new TextEncoder().encode(part);
    const bytes = idBytes(part);
    return Uint8Array.from(bytes.length ? bytes : [0]);
  });
  const size = body.reduce((sum, part) => sum + part.length, 0);
  const head = [...idBytes(id), 0x01];
  for (let shift = 48; shift >= 0; shift -= 8) head.push(Math.floor(size / 2 ** shift) % 256);
  const whole = new Uint8Array(head.length + size);
  whole.set(head);
  let at = head.length;
  for (const part of body) {
    whole.set(part, at);
    at += part.length;
  }
  return whole;
}

function double(value) {
  const bytes = new Uint8Array(8);
  new DataView(bytes.buffer).setFloat64(0, value);
  return bytes;
}

/**
 * @param {{data: Uint8Array, key: boolean}[]} frames encoded, in order
 * @param {{width: number, height: number, rate: number, codec: string}} video codec: "V_VP8",
 *   "V_VP9"
 */
function toWebm(frames, { width, height, rate, codec }) {
  const timeOf = (i) => Math.round((i * 1000) / rate);
  const clusters = [];
  let blocks = [];
  let start = 0;
  const close = () => {
    if (blocks.length) {
      clusters.push(element(IDS.cluster, element(IDS.time, timeOf(start)), ...blocks));
    }
    blocks = [];
  };
  frames.forEach(({ data, key }, i) => {
    if (key || timeOf(i) - timeOf(start) > 30000) {
      close();
      start = i;
    }
    const block = new Uint8Array(4 + data.length);
    block.set([0x81, 0, 0, key ? 0x80 : 0]);
    new DataView(block.buffer).setInt16(1, timeOf(i) - timeOf(start));
    block.set(data, 4);
    blocks.push(element(IDS.block, block));
  });
  close();
  const header = element(IDS.header, element(IDS.version, 1), element(IDS.readVersion, 1),
    element(IDS.idLength, 4), element(IDS.sizeLength, 8), element(IDS.docType, 'webm'),
    element(IDS.docVersion, 4), element(IDS.docReadVersion, 2));
  const info = element(IDS.info, element(IDS.scale, 1000000),
    element(IDS.duration, double(timeOf(frames.length))),
    element(IDS.muxer, 'morphod'), element(IDS.writer, 'morphod'));
  const video = element(IDS.video, element(IDS.width, width), element(IDS.height, height));
  const tracks = element(IDS.tracks, element(IDS.track, element(IDS.number, 1),
    element(IDS.uid, 1), element(IDS.type, 1), element(IDS.codec, codec), video));
  return new Blob([header, element(IDS.segment, info, tracks, ...clusters)],
    { type: 'video/webm' });
}

// Debian's TypeScript does not have types for WebCodecs yet.
const { VideoEncoder, VideoFrame } = /** @type {any} */ (window);

const CODECS = [['vp09.00.40.08', 'V_VP9'], ['vp8', 'V_VP8']];

/**
 * Draws and encodes a film, every frame at its exact time.
 * @param {HTMLCanvasElement} canvas
 * @param {function(number): void} draw draws the canvas at a time in seconds
 * @param {{durationS: number, rate?: number, onprogress?: function(number): void}} options
 * @returns {Promise<Blob>}
 */
export async function record(canvas, draw, { durationS, rate = 50, onprogress = () => {} }) {
  draw(0);
  // Encoders need even sizes.
  const [width, height] = [canvas.width & ~1, canvas.height & ~1];
  let chosen = null;
  for (const [codec, name] of CODECS) {
    const config = { codec, width, height, bitrate: 6e6, framerate: rate };
    if ((await VideoEncoder.isConfigSupported(config)).supported) {
      chosen = { config, name };
      break;
    }
  }
  if (!chosen) throw new Error('This browser cannot encode WebM; use the command instead.');
  const frames = [];
  let failure = null;
  const encoder = new VideoEncoder({
    output: (chunk) => {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      frames.push({ data, key: chunk.type === 'key' });
    },
    error: (error) => { failure = error; },
  });
  try {
    encoder.configure(chosen.config);
    const n = Math.max(1, Math.round(durationS * rate));
    for (let i = 0; i < n && !failure; i++) {
      draw(i / rate);
      const frame = new VideoFrame(canvas, {
        timestamp: Math.round((i * 1e6) / rate), visibleRect: { x: 0, y: 0, width, height },
      });
      encoder.encode(frame, { keyFrame: i % (rate * 2) === 0 });
      frame.close();
      while (encoder.encodeQueueSize > 4) await new Promise((resolve) => setTimeout(resolve, 1));
      onprogress((i + 1) / n);
    }
    await encoder.flush();
    if (failure) throw failure;
  } finally {
    if (encoder.state !== 'closed') encoder.close();
  }
  return toWebm(frames, { width, height, rate, codec: chosen.name });
}
