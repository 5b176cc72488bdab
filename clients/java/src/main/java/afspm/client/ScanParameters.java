package afspm.client;

import afspm.Geometry.Size2u;
import afspm.Scan.DataAspects;
import afspm.Scan.ScanParameters2d;
import java.util.Objects;

/** Region and number of pixels of the next scan. */
public final class ScanParameters {
    private final Region region;
    private final int rows;
    private final int columns;

    ScanParameters(Region region, int rows, int columns) {
        if (rows < 0 || columns < 0 || (rows == 0) != (columns == 0)) {
            throw new InvalidValueException("a scan can't have " + rows + " rows and " + columns + " columns");
        }
        this.region = region;
        this.rows = rows;
        this.columns = columns;
    }

    static ScanParameters of(ScanParameters2d message) {
        Size2u shape = message.getData().getShape();
        boolean isWhole = shape.hasX() && shape.hasY();
        return new ScanParameters(Region.of(message.getSpatial()), isWhole ? shape.getY() : 0, isWhole ? shape.getX() : 0);
    }

    ScanParameters2d toWire() {
        ScanParameters2d.Builder message = ScanParameters2d.newBuilder();
        if (region != null) {
            message.setSpatial(region.toWire());
        }
        if (rows > 0) {
            message.setData(DataAspects.newBuilder().setShape(Size2u.newBuilder().setX(columns).setY(rows)));
        }
        return message.build();
    }

    /** Return the region; null: unknown or unchanged. */
    public Region region() {
        return region;
    }

    /** Return the number of rows; 0: unknown or unchanged. */
    public int rows() {
        return rows;
    }

    public int columns() {
        return columns;
    }

    /** Whether the parameters in force match these within {@code tolerance} of the size. */
    boolean isSetBy(ScanParameters now, double tolerance) {
        if (now == null || (rows > 0 && (rows != now.rows || columns != now.columns))) {
            return false;
        }
        return region == null || (now.region != null && region.isNear(now.region, tolerance));
    }

    @Override
    public boolean equals(Object other) {
        return other instanceof ScanParameters && toString().equals(other.toString());
    }

    @Override
    public int hashCode() {
        return Objects.hash(rows, columns);
    }

    @Override
    public String toString() {
        return region == null ? rows + " x " + columns + " pixels" : region.toWire().toString() + rows + " x " + columns;
    }
}
