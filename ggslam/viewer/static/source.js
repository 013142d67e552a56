// SPDX-License-Identifier: Apache-2.0
// Where the map comes from: this file itself, or the program that serves the page.

class FileSource {
  constructor(scene, text) {
    this.inline = scene;
    this.text = text;
    this.served = false;
  }

  async scene() {
    return this.inline;
  }

  async splats() {
    return unpackSplats(Uint8Array.from(atob(this.text), (letter) => letter.charCodeAt(0)).buffer, this.inline.splats);
  }

  picture(frame) {
    return frame.picture;
  }

  listen() {}
}

class ServerSource {
  constructor() {
    this.served = true;
    this.version = 0;
  }

  async scene() {
    return this.get("scene").then((answer) => answer.json());
  }

  async splats(chunk, level = 0) {
    const buffer = await this.get(`splats?chunk=${encodeURIComponent(chunk)}&level=${level}`).then((answer) =>
      answer.arrayBuffer(),
    );
    const size = new DataView(buffer).getUint32(0, true),
      header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
    return unpackSplats(buffer.slice(4 + size), header);
  }

  picture(frame) {
    return `frame?number=${frame.frame}&version=${this.version}`;
  }

  async fetch(...request) {
    try {
      return await fetch(...request);
    } catch {
      throw new Error("the program that serves this page does not answer"); // browsers have words of their own
    }
  }

  async get(address) {
    const answer = await this.fetch(address);
    if (!answer.ok)
      throw new Error((await answer.json().catch(() => ({}))).error || `the program answered ${answer.status}`);
    return answer;
  }

  async post(action, values, method = "POST") {
    const answer = await this.fetch(action, {
      method,
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify(values),
    });
    if (!answer.ok)
      throw new Error((await answer.json().catch(() => ({}))).error || `the program answered ${answer.status}`);
    if (answer.headers.get("Content-Type") !== "application/json") return answer.blob();
    const found = await answer.json();
    if (found.error) throw new Error(found.error);
    return found;
  }

  // news: {what: [...], version, text, T_world_camera}; lost(true) while the program is not there.
  listen(news, lost) {
    const events = new EventSource("events");
    events.onmessage = (event) => news(JSON.parse(event.data));
    events.onerror = () => lost(true);
    events.onopen = () => lost(false);
  }
}
