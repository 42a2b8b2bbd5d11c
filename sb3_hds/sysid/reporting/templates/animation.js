(function () {
  const data = JSON.parse(document.getElementById("motion").textContent);
  const groups = document.querySelectorAll(".stage g"), n = data.time.length;
  const cursors = document.querySelectorAll(".errors .cursor");
  const slider = document.getElementById("frame"), button = document.getElementById("play");
  const clock = document.getElementById("clock");
  document.querySelector(".controls").hidden = false;
  slider.max = n - 1;
  let now = data.still, since = null;
  function show(frame) {
    now = frame;
    groups.forEach(function (group, player) {
      const ends = data.lines[player][frame], shapes = data.outlines[player][frame];
      group.querySelectorAll("polygon").forEach(function (outline, i) {
        outline.setAttribute("points", shapes[i].join(" "));
      });
      group.querySelectorAll("line").forEach(function (line, i) {
        ["x1", "y1", "x2", "y2"].forEach(function (name, k) {
          line.setAttribute(name, ends[4 * i + k]);
        });
      });
    });
    const share = 100 * data.time[frame] / (data.time[n - 1] || 1);
    cursors.forEach(function (line) { line.setAttribute("x1", share);
      line.setAttribute("x2", share); });
    slider.value = frame;
    clock.textContent = data.time[frame].toFixed(2) + " s";
  }
  function advance(stamp) {
    if (since === null) { return; }
    const time = (stamp - since) / 1000;
    let frame = now;
    while (frame < n - 1 && data.time[frame] < time) { frame += 1; }
    show(frame);
    if (frame < n - 1) { requestAnimationFrame(advance); } else { stop(); }
  }
  function stop() { since = null; button.textContent = "Play"; }
  button.addEventListener("click", function () {
    if (since !== null) { stop(); return; }
    if (now >= n - 1) { show(0); }
    button.textContent = "Pause";
    requestAnimationFrame(function (stamp) {
      since = stamp - 1000 * data.time[now];
      advance(stamp);
    });
  });
  slider.addEventListener("input", function () { stop(); show(Number(slider.value)); });
  show(now);
})();
