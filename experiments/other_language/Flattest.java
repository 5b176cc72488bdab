// Takes an overview, finds its flattest place, and scans that: a component in Java, with the client in clients/java.

import afspm.client.Component;
import afspm.client.Experiment;
import afspm.client.Region;
import afspm.client.Scan;
import afspm.client.ScanSet;

public class Flattest {
    public static void main(String[] arguments) {
        Component.run(Flattest::scanFlattest);
    }

    private static void scanFlattest(Experiment experiment) {
        double sizeM = experiment.launch().number("size_m");
        int tiles = (int) experiment.launch().number("tiles");
        int pixels = (int) experiment.launch().number("pixels");
        // a key has a scan taken once: started again after a crash, this program gets the scan of its earlier life
        ScanSet overview = experiment.scan(new Region(0, 0, sizeM, sizeM), pixels, pixels, "overview");
        Scan height = overview.stream().filter(scan -> scan.unit().equals("m")).findFirst().orElse(overview.get(0));

        int edge = pixels / tiles;
        int flattest = 0;
        for (int tile = 1; tile < tiles * tiles; tile++) {
            if (roughness(height, tile, tiles, edge) < roughness(height, flattest, tiles, edge)) {
                flattest = tile;
            }
        }

        double[] center = height.placeM(flattest / tiles * edge + (edge - 1) / 2.0, flattest % tiles * edge + (edge - 1) / 2.0);
        Region region = new Region(center[0], center[1], sizeM / tiles, sizeM / tiles);
        ScanSet detail = experiment.scan(region, pixels, pixels, "flattest");
        String place = String.format("(%.0f, %.0f) nm", center[0] * 1e9, center[1] * 1e9);
        double roughness = roughness(height, flattest, tiles, edge);
        experiment.note(String.format("the flattest place, %.3f nm rms, is at %s", roughness * 1e9, place), detail.get(0));
        experiment.log("scanned the flattest place at " + place);
        experiment.end();
        experiment.untilEnd();
    }

    /** Return the root mean square of the heights of a square tile about its plane. */
    private static double roughness(Scan scan, int tile, int tiles, int edge) {
        double middle = (edge - 1) / 2.0;
        double sum = 0;
        double sumX = 0;
        double sumY = 0;
        double squares = 0;
        double squaresX = 0;
        for (int y = 0; y < edge; y++) {
            for (int x = 0; x < edge; x++) {
                double z = scan.at(tile / tiles * edge + y, tile % tiles * edge + x);
                sum += z;
                sumX += z * (x - middle);
                sumY += z * (y - middle);
                squares += z * z;
                squaresX += (x - middle) * (x - middle);
            }
        }
        int count = edge * edge;
        return Math.sqrt(Math.max(0, squares - sum * sum / count - (sumX * sumX + sumY * sumY) / squaresX) / count);
    }
}
