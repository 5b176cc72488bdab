package afspm.client;

import com.google.gson.JsonArray;
import com.google.gson.JsonElement;
import com.google.gson.JsonObject;
import com.google.gson.JsonPrimitive;
import com.google.protobuf.ByteString;
import com.google.protobuf.Descriptors.Descriptor;
import com.google.protobuf.Descriptors.EnumValueDescriptor;
import com.google.protobuf.Descriptors.FieldDescriptor;
import com.google.protobuf.Descriptors.FileDescriptor;
import com.google.protobuf.DynamicMessage;
import com.google.protobuf.Message;
import com.google.protobuf.Timestamp;
import java.io.IOException;
import java.math.BigDecimal;
import java.nio.file.Files;
import java.nio.file.Path;
import java.nio.file.Paths;
import java.time.Instant;
import java.util.ArrayList;
import java.util.Base64;
import java.util.List;
import java.util.Locale;
import java.util.Map;
import java.util.stream.Stream;

/** Messages in protobuf's JSON mapping. The mapping of protobuf-java-util takes minus zero for zero. */
final class JsonMapping {
    private static final List<FileDescriptor> FILES = files();

    private JsonMapping() {
    }

    /** Return a builder of a message by its name. */
    static Message.Builder builder(String name) {
        for (FileDescriptor file : FILES) {
            Descriptor message = file.findMessageTypeByName(name);
            if (message != null) {
                return DynamicMessage.newBuilder(message);
            }
        }
        throw new IllegalArgumentException("no message " + name);
    }

    static Message.Builder merge(JsonObject json, Message.Builder message) {
        for (Map.Entry<String, JsonElement> entry : json.entrySet()) {
            FieldDescriptor field = message.getDescriptorForType().findFieldByName(entry.getKey());
            if (field == null) {
                throw new IllegalArgumentException("no field " + entry.getKey());
            }
            if (field.isRepeated()) {
                entry.getValue().getAsJsonArray().forEach(one -> message.addRepeatedField(field, value(field, one, message)));
            } else if (!entry.getValue().isJsonNull()) {
                message.setField(field, value(field, entry.getValue(), message));
            }
        }
        return message;
    }

    static JsonObject json(Message message) {
        JsonObject json = new JsonObject();
        message.getAllFields().forEach((field, value) -> {
            if (field.isRepeated()) {
                JsonArray array = new JsonArray();
                ((List<?>) value).forEach(one -> array.add(json(field, one)));
                json.add(field.getName(), array);
            } else {
                json.add(field.getName(), json(field, value));
            }
        });
        return json;
    }

    private static Object value(FieldDescriptor field, JsonElement json, Message.Builder message) {
        switch (field.getJavaType()) {
            case DOUBLE:
                return json.getAsDouble();
            case FLOAT:
                return json.getAsFloat();
            case INT:
                return (int) json.getAsLong();
            case LONG:
                return Long.parseUnsignedLong(json.getAsString());
            case BOOLEAN:
                return json.getAsBoolean();
            case BYTE_STRING:
                return ByteString.copyFrom(Base64.getDecoder().decode(json.getAsString()));
            case ENUM:
                boolean isNumber = json.getAsJsonPrimitive().isNumber();
                return isNumber ? field.getEnumType().findValueByNumberCreatingIfUnknown(json.getAsInt())
                        : field.getEnumType().findValueByName(json.getAsString());
            case MESSAGE:
                if (isTimestamp(field)) {
                    Instant time = Instant.parse(json.getAsString());
                    return Timestamp.newBuilder().setSeconds(time.getEpochSecond()).setNanos(time.getNano()).build();
                }
                return merge(json.getAsJsonObject(), message.newBuilderForField(field)).build();
            default:
                return json.getAsString();
        }
    }

    private static JsonElement json(FieldDescriptor field, Object value) {
        switch (field.getJavaType()) {
            case DOUBLE:
            case INT:
                return new JsonPrimitive((Number) value);
            case FLOAT:
                return new JsonPrimitive(new BigDecimal(value.toString()));
            case LONG:
                return new JsonPrimitive(value.toString());
            case BOOLEAN:
                return new JsonPrimitive((Boolean) value);
            case BYTE_STRING:
                return new JsonPrimitive(Base64.getEncoder().encodeToString(((ByteString) value).toByteArray()));
            case ENUM:
                EnumValueDescriptor known = (EnumValueDescriptor) value;
                return known.getIndex() < 0 ? new JsonPrimitive(known.getNumber()) : new JsonPrimitive(known.getName());
            case MESSAGE:
                return isTimestamp(field) ? new JsonPrimitive(instant((Message) value).toString()) : json((Message) value);
            default:
                return new JsonPrimitive((String) value);
        }
    }

    /** Return the descriptor of each file of `proto`, so that a new file's messages are known here. */
    private static List<FileDescriptor> files() {
        try (Stream<Path> listed = Files.list(Paths.get("..", "..", "proto"))) {
            List<FileDescriptor> files = new ArrayList<>();
            for (Path file : (Iterable<Path>) listed.filter(path -> path.toString().endsWith(".proto"))::iterator) {
                String name = file.getFileName().toString().replace(".proto", "");
                Class<?> generated = Class.forName("afspm." + name.substring(0, 1).toUpperCase(Locale.ROOT) + name.substring(1));
                files.add((FileDescriptor) generated.getMethod("getDescriptor").invoke(null));
            }
            return files;
        } catch (IOException | ReflectiveOperationException error) {
            throw new AssertionError(error);
        }
    }

    private static boolean isTimestamp(FieldDescriptor field) {
        return field.getMessageType().getFullName().equals("google.protobuf.Timestamp");
    }

    private static Instant instant(Message time) {
        Descriptor type = time.getDescriptorForType();
        return Instant.ofEpochSecond((Long) time.getField(type.findFieldByName("seconds")), (Integer) time.getField(type.findFieldByName("nanos")));
    }
}
