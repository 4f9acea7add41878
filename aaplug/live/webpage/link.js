// The link to the server: one websocket, opened again when it is lost.

const PART_BYTES = 65_536, MAX_WAITING_BYTES = 1 << 22; // of a file that is sent
const RETRY_MS = [500, 1000, 2000, 5000]; // ms before the next attempts

function linked(on) { // on.hello(about), on.message(header, files), on.lost()
  let socket = null, attempts = 0, chain = Promise.resolve();
  const words = new TextDecoder();

  async function unpacked(data) {
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(words.decode(new Uint8Array(data, 4, length)));
    try {
      await handed(header, data, length);
    } finally { // or the server would wait for this page; it counts no refusal
      if (!header.refused && !header.take) send({shown: header.id || 0});
    }
  }

  async function handed(header, data, length) {
    let at = 4 + length;
    const files = (header.parts || []).map(({bytes}) => new Blob([data.slice(at, at += bytes)]));
    if (header.still) files.push(new Blob([data.slice(at)], {type: "image/png"}));
    await on.message(header, header.still ? files : await Promise.all(files.map((file) => createImageBitmap(file))));
  }

  function open() {
    const address = new URL("live", location.href);
    address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
    address.search = location.search;
    socket = new WebSocket(address);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({data}) => {
      attempts = 0;
      if (typeof data === "string") on.hello(JSON.parse(data));
      else chain = chain.then(() => unpacked(data)).catch((error) => console.error(error));
    };
    socket.onclose = () => {
      on.lost();
      setTimeout(open, RETRY_MS[Math.min(attempts++, RETRY_MS.length - 1)]);
    };
  }

  function send(message) {
    if (socket.readyState !== WebSocket.OPEN) return false;
    socket.send(JSON.stringify(message));
    return true;
  }

  async function sendFile(file) { // in parts, no faster than the server takes them
    for (let at = 0; at < file.size; at += PART_BYTES) {
      socket.send(await file.slice(at, at + PART_BYTES).arrayBuffer());
      while (socket.bufferedAmount > MAX_WAITING_BYTES) await new Promise((resume) => setTimeout(resume, 20));
    }
  }

  open();
  return {send, sendFile, drop: () => socket.close()};
}
