package afspm.client;

import afspm.Geometry.Point2d;
import afspm.Geometry.RotRect2d;
import afspm.Geometry.Size2d;
import afspm.Scan.SpatialAspects;
import java.util.Locale;

/** A rectangle rotated about its centre; x points right, y up. */
public final class Region {
    private final double xM;
    private final double yM;
    private final double widthM;
    private final double heightM;
    private final double angleRad;

    /** Create an unrotated rectangle from its centre and size in metres. */
    public Region(double xM, double yM, double widthM, double heightM) {
        this(xM, yM, widthM, heightM, 0);
    }

    /**
     * Create a rectangle from its centre and size.
     *
     * @param xM the centre, in metres
     * @param yM the centre, in metres
     * @param widthM in metres, before the rotation; above zero
     * @param heightM in metres, before the rotation; above zero
     * @param angleRad counter-clockwise, in radians
     * @throws InvalidValueException a value is not finite, or a size not above zero
     */
    public Region(double xM, double yM, double widthM, double heightM, double angleRad) {
        for (double value : new double[] {xM, yM, widthM, heightM, angleRad}) {
            if (Double.isNaN(value) || Double.isInfinite(value)) {
                throw new InvalidValueException("a region needs finite numbers");
            }
        }
        if (!(widthM > 0 && heightM > 0)) {
            throw new InvalidValueException("a region of " + widthM + " m x " + heightM + " m is empty");
        }
        this.xM = xM;
        this.yM = yM;
        this.widthM = widthM;
        this.heightM = heightM;
        this.angleRad = angleRad;
    }

    public double xM() {
        return xM;
    }

    public double yM() {
        return yM;
    }

    public double widthM() {
        return widthM;
    }

    public double heightM() {
        return heightM;
    }

    public double angleRad() {
        return angleRad;
    }

    /** Return the position in metres, as {x, y}, at the fractions (u, v) of the sides, each from -0.5 to 0.5. */
    public double[] placeM(double u, double v) {
        double cos = Math.cos(angleRad);
        double sin = Math.sin(angleRad);
        return new double[] {xM + cos * u * widthM - sin * v * heightM, yM + sin * u * widthM + cos * v * heightM};
    }

    @Override
    public String toString() {
        return String.format(Locale.ROOT, "%g m x %g m at (%g, %g) m, turned by %g rad", widthM, heightM, xM, yM, angleRad);
    }

    Region movedTo(Region other) {
        return new Region(other.xM, other.yM, widthM, heightM, angleRad);
    }

    /** Whether all corners of two regions differ by less than {@code tolerance} of their size. */
    boolean isNear(Region other, double tolerance) {
        double size = Math.hypot(widthM, heightM);
        double turned = Math.IEEEremainder(angleRad - other.angleRad, 2 * Math.PI);
        return distanceM(other) <= tolerance * size
                && Math.hypot(widthM - other.widthM, heightM - other.heightM) <= tolerance * size
                && Math.abs(turned) <= tolerance;
    }

    double distanceM(Region other) {
        return Math.hypot(xM - other.xM, yM - other.yM);
    }

    SpatialAspects toWire() {
        return SpatialAspects.newBuilder()
                .setRoi(RotRect2d.newBuilder()
                        .setTopLeft(Point2d.newBuilder().setX(xM - widthM / 2).setY(yM - heightM / 2))
                        .setSize(Size2d.newBuilder().setX(widthM).setY(heightM))
                        .setAngle(Units.convert(angleRad, "rad", "deg")))
                .setLengthUnits("m")
                .setAngularUnits("deg")
                .build();
    }

    /** Return the region of a message; null if it is incomplete. */
    static Region of(SpatialAspects spatial) {
        RotRect2d roi = spatial.getRoi();
        Point2d corner = roi.getTopLeft();
        Size2d size = roi.getSize();
        if (!corner.hasX() || !corner.hasY() || !size.hasX() || !size.hasY()) {
            return null;
        }
        String unit = spatial.getLengthUnits().isEmpty() ? "m" : spatial.getLengthUnits();
        String angularUnit = spatial.getAngularUnits().isEmpty() ? "deg" : spatial.getAngularUnits();
        double width = Units.convert(size.getX(), unit, "m");
        double height = Units.convert(size.getY(), unit, "m");
        return new Region(Units.convert(corner.getX(), unit, "m") + width / 2, Units.convert(corner.getY(), unit, "m") + height / 2,
                width, height, Units.convert(roi.getAngle(), angularUnit, "rad"));
    }
}
