// Takes an overview, finds its flattest place, and scans that: a component in JavaScript, with the client in clients/typescript.
import { runComponent } from "../../clients/typescript/dist/src/index.js";

runComponent(async (experiment) => {
  const { size_m: sizeM, tiles, pixels } = experiment.launch.settings;
  // a key has a scan taken once: started again after a crash, this program gets the scan of its earlier life
  const overview = await experiment.scan({ centerM: [0, 0], sizeM: [sizeM, sizeM] }, { shape: [pixels, pixels], key: "overview" });
  const height = overview.scans.find(({ unit }) => unit === "m") ?? overview.scans[0];

  const edge = Math.floor(pixels / tiles);
  const places = Array.from({ length: tiles * tiles }, (_, index) => {
    const [row, column] = [Math.floor(index / tiles) * edge, (index % tiles) * edge];
    return { row, column, roughness: roughness(height, row, column, edge) };
  });
  const flattest = places.reduce((best, one) => (one.roughness < best.roughness ? one : best));

  const centerM = height.placeM(flattest.row + (edge - 1) / 2, flattest.column + (edge - 1) / 2);
  const detail = await experiment.scan({ centerM, sizeM: [sizeM / tiles, sizeM / tiles] }, { shape: [pixels, pixels], key: "flattest" });
  const nanometres = centerM.map((metres) => (metres * 1e9).toFixed(0)).join(", ");
  await experiment.note(`the flattest place, ${(flattest.roughness * 1e9).toFixed(3)} nm rms, is at (${nanometres}) nm`, detail.scans[0]);
  experiment.log("INFO", `scanned the flattest place at (${nanometres}) nm`);
  await experiment.end();
  await experiment.untilEnd();
});

/** Return the root mean square of the heights of a square tile about its plane. */
function roughness(scan, row, column, edge) {
  const middle = (edge - 1) / 2;
  let [sum, sumX, sumY, squares, sumXX] = [0, 0, 0, 0, 0];
  for (let y = 0; y < edge; y++) {
    for (let x = 0; x < edge; x++) {
      const z = scan.at(row + y, column + x);
      sum += z;
      sumX += z * (x - middle);
      sumY += z * (y - middle);
      squares += z * z;
      sumXX += (x - middle) ** 2;
    }
  }
  const count = edge * edge;
  return Math.sqrt(Math.max(0, squares - sum ** 2 / count - (sumX ** 2 + sumY ** 2) / sumXX) / count);
}
