// SPDX-License-Identifier: Apache-2.0
// A map that grows while it is looked at. A part of `Viewer`.

class ViewerGrowing {
  listen() {
    this.source.listen(
      async (news) => {
        this.source.version = news.version || this.source.version;
        if (news.text) {
          document.getElementById("about").textContent = news.text;
        }
        if (news.what.includes("splats") || news.what.includes("scene") || news.what.includes("path")) {
          this.stale ||= news.what.includes("splats") || news.what.includes("path") || !this.scene.chunks;
          if (this.reloading) {
            this.again = true;
            return;
          }
          this.reloading = true;
          do {
            this.again = false;
            const splats = this.stale;
            this.stale = false;
            await this.try(() => this.reload(splats));
          } while (this.again);
          this.reloading = false;
        }
        if (news.T_world_camera && this.scene.live) this.followCamera(news.T_world_camera);
        this.emit("news", news);
      },
      (lost) => {
        if (lost !== this.lost) {
          this.lost = lost;
          this.say(lost ? "the program that serves this page is gone" : "", lost);
        }
      },
    );
  }

  followCamera(T) {
    this.map.setLines("now", frustumSegments(T, this.scene.camera, 0.12), [255, 235, 60], 2);
    if (!this.follow) return;
    const forward = [T[2], T[6], T[10]],
      up = [-T[1], -T[5], -T[9]],
      p = [T[3], T[7], T[11]];
    this.camera.glide({ position: add(add(p, forward, -0.8), up, 0.4), look_at: add(p, forward, 2), up }, 0.9);
  }
}
