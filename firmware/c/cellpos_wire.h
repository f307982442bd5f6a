/* The wire between cellpos and a PZT board, protocol version 2: encoder and decoder in one C99 file.
 *
 * No allocation, no library but <stdint.h>, <stddef.h> and <stdbool.h>. Layouts and meaning: docs/board.md.
 * Both directions are here, so that a board (decodes to-board, encodes to-host) and a host can use it.
 * The tests decode and encode docs/protocol-vectors.json and a million random byte strings with this file and with the
 * Rust code of the project, and compare.
 *
 *   static cw_decoder rx;                      // zero-initialised
 *   cw_message m;
 *   if (cw_push(&rx, CW_TO_BOARD, byte, &m))   // for every byte that arrives
 *       handle(&m);
 *   size_t n = cw_encode(&answer, out, sizeof out);   // 0: out is too short; CW_MAX_FRAME always suffices
 */
#ifndef CELLPOS_WIRE_H
#define CELLPOS_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define CW_PROTOCOL_VERSION 2u
#define CW_MAX_PAYLOAD 96u                             /* bytes of a message */
#define CW_MAX_BODY (1u + CW_MAX_PAYLOAD + 4u)         /* direction, message, CRC-32 */
#define CW_MAX_ENCODED (CW_MAX_BODY + 1u)              /* after COBS */
#define CW_MAX_FRAME (CW_MAX_ENCODED + 2u)             /* with both zeros */

typedef enum { CW_TO_BOARD = 0xb1, CW_TO_HOST = 0x4e } cw_direction;

/* Messages of both directions; the number on the wire is the value without the high bits. */
typedef enum {
    CW_HELLO = 0, CW_ARM, CW_COMMAND, CW_FREEZE, CW_PARK, CW_DISARM, CW_LED, CW_STATUS_REQUEST, CW_PING,
    CW_IDENTITY = 0x100, CW_ACK, CW_REFUSED, CW_STATUS, CW_FAULT, CW_PONG
} cw_kind;

enum { CW_REQUESTS = 7, CW_REFUSALS = 6, CW_STATES = 6, CW_FAULTS = 4 };

typedef struct { int32_t low_pm, high_pm; uint32_t slew_nm_per_s; } cw_limits;

typedef struct {
    uint16_t session;
    bool has_watchdog, has_hold_watchdog, has_park, has_limits;
    uint16_t watchdog_ms, hold_watchdog_ms;
    int32_t park_pm;
    cw_limits limits;
    bool interpolate;
    uint16_t status_every;
} cw_arm;

typedef struct {
    uint16_t session;
    uint32_t seq;
    uint64_t time_us;
    int32_t displacement_pm, neutral_pm;
} cw_command;

typedef struct {
    uint16_t protocol;
    uint8_t firmware[3];
    uint32_t serial;
    cw_limits limits;
    uint32_t ramp_nm_per_s;
    int32_t park_pm;
    uint8_t dac_bits;
    uint16_t watchdog_ms, hold_watchdog_ms;
} cw_identity;

typedef struct {
    uint16_t session;
    bool has_last_seq;
    uint32_t last_seq;
    uint64_t last_time_us;
    uint8_t state; /* CW_STATES of them */
    int32_t applied_pm, neutral_pm;
    uint64_t board_time_us;
    uint8_t fault; /* CW_FAULTS of them */
    bool led;
    uint32_t bad_frames, ignored, late, clipped, unsent;
    uint16_t holds;
} cw_status;

typedef struct {
    cw_kind kind;
    union {
        uint16_t hello_protocol;
        cw_arm arm;
        cw_command command;
        bool led_on;
        uint32_t ping_token;
        cw_identity identity;
        uint8_t ack_request;
        struct { uint8_t request, refusal; } refused;
        cw_status status;
        struct { uint8_t fault; uint64_t board_time_us; } fault;
        struct { uint32_t token; uint64_t board_time_us; } pong;
    } as;
} cw_message;

/* A decoder of one direction; all zero to begin with. */
typedef struct {
    uint8_t bytes[CW_MAX_ENCODED];
    size_t filled;
    bool overlong;
    uint32_t bad_frames;
} cw_decoder;

/* CRC-32 of Ethernet and zip: reflected, polynomial 0xedb88320, start and final xor 0xffffffff. */
static uint32_t cw_crc32(const uint8_t *data, size_t length) {
    uint32_t crc = 0xffffffffu;
    for (size_t i = 0; i < length; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1u) ? 0xedb88320u : 0u);
    }
    return crc ^ 0xffffffffu;
}

/* ---- reading ---- */

typedef struct { const uint8_t *at, *end; bool bad; } cw_reader;

static uint8_t cw_byte(cw_reader *r) {
    if (r->bad || r->at == r->end) { r->bad = true; return 0; }
    return *r->at++;
}

/* Little-endian groups of seven bits, the highest bit set on all but the last; `bits` wide. */
static uint64_t cw_varint(cw_reader *r, unsigned bits) {
    uint64_t value = 0;
    unsigned groups = (bits + 6u) / 7u;
    for (unsigned i = 0; i < groups; i++) {
        uint8_t byte = cw_byte(r);
        if (r->bad) return 0;
        value |= (uint64_t)(byte & 0x7fu) << (7u * i);
        if (!(byte & 0x80u)) {
            unsigned room = bits - 7u * i; /* bits left for this group */
            if (i + 1u == groups && room < 7u && (byte >> room) != 0) { r->bad = true; return 0; }
            return value;
        }
    }
    r->bad = true; /* longer than its type */
    return 0;
}

static uint16_t cw_u16(cw_reader *r) { return (uint16_t)cw_varint(r, 16); }
static uint32_t cw_u32(cw_reader *r) { return (uint32_t)cw_varint(r, 32); }
static uint64_t cw_u64(cw_reader *r) { return cw_varint(r, 64); }

/* Zigzag: 0, -1, 1, -2, ... */
static int32_t cw_i32(cw_reader *r) {
    uint32_t z = cw_u32(r);
    uint32_t magnitude = z >> 1;
    return (z & 1u) ? -(int32_t)magnitude - 1 : (int32_t)magnitude;
}

static bool cw_bool(cw_reader *r) {
    uint8_t byte = cw_byte(r);
    if (byte > 1) r->bad = true;
    return byte == 1;
}

/* The number of a variant, below `count`. */
static uint8_t cw_variant(cw_reader *r, uint32_t count) {
    uint32_t number = cw_u32(r);
    if (number >= count) { r->bad = true; return 0; }
    return (uint8_t)number;
}

static cw_limits cw_read_limits(cw_reader *r) {
    cw_limits l;
    l.low_pm = cw_i32(r);
    l.high_pm = cw_i32(r);
    l.slew_nm_per_s = cw_u32(r);
    return l;
}

static void cw_read_arm(cw_reader *r, cw_arm *a) {
    a->session = cw_u16(r);
    if ((a->has_watchdog = cw_bool(r))) a->watchdog_ms = cw_u16(r);
    if ((a->has_hold_watchdog = cw_bool(r))) a->hold_watchdog_ms = cw_u16(r);
    if ((a->has_park = cw_bool(r))) a->park_pm = cw_i32(r);
    if ((a->has_limits = cw_bool(r))) a->limits = cw_read_limits(r);
    a->interpolate = cw_bool(r);
    a->status_every = cw_u16(r);
}

static void cw_read_status(cw_reader *r, cw_status *s) {
    s->session = cw_u16(r);
    if ((s->has_last_seq = cw_bool(r))) s->last_seq = cw_u32(r);
    s->last_time_us = cw_u64(r);
    s->state = cw_variant(r, CW_STATES);
    s->applied_pm = cw_i32(r);
    s->neutral_pm = cw_i32(r);
    s->board_time_us = cw_u64(r);
    s->fault = cw_variant(r, CW_FAULTS);
    s->led = cw_bool(r);
    s->bad_frames = cw_u32(r);
    s->ignored = cw_u32(r);
    s->late = cw_u32(r);
    s->clipped = cw_u32(r);
    s->unsent = cw_u32(r);
    s->holds = cw_u16(r);
}

static void cw_read_identity(cw_reader *r, cw_identity *i) {
    i->protocol = cw_u16(r);
    for (int k = 0; k < 3; k++) i->firmware[k] = cw_byte(r);
    i->serial = cw_u32(r);
    i->limits = cw_read_limits(r);
    i->ramp_nm_per_s = cw_u32(r);
    i->park_pm = cw_i32(r);
    i->dac_bits = cw_byte(r);
    i->watchdog_ms = cw_u16(r);
    i->hold_watchdog_ms = cw_u16(r);
}

/* A whole message of one direction; false unless every byte is used and means something. */
static bool cw_read_message(cw_direction direction, const uint8_t *data, size_t length, cw_message *m) {
    cw_reader reader = { data, data + length, false }, *r = &reader;
    if (direction == CW_TO_BOARD) {
        m->kind = (cw_kind)cw_variant(r, 9);
        switch (m->kind) {
        case CW_HELLO: m->as.hello_protocol = cw_u16(r); break;
        case CW_ARM: cw_read_arm(r, &m->as.arm); break;
        case CW_COMMAND:
            m->as.command.session = cw_u16(r);
            m->as.command.seq = cw_u32(r);
            m->as.command.time_us = cw_u64(r);
            m->as.command.displacement_pm = cw_i32(r);
            m->as.command.neutral_pm = cw_i32(r);
            break;
        case CW_LED: m->as.led_on = cw_bool(r); break;
        case CW_PING: m->as.ping_token = cw_u32(r); break;
        default: break; /* freeze, park, disarm, status request: nothing more */
        }
    } else {
        m->kind = (cw_kind)(0x100 + cw_variant(r, 6));
        switch (m->kind) {
        case CW_IDENTITY: cw_read_identity(r, &m->as.identity); break;
        case CW_ACK: m->as.ack_request = cw_variant(r, CW_REQUESTS); break;
        case CW_REFUSED:
            m->as.refused.request = cw_variant(r, CW_REQUESTS);
            m->as.refused.refusal = cw_variant(r, CW_REFUSALS);
            break;
        case CW_STATUS: cw_read_status(r, &m->as.status); break;
        case CW_FAULT:
            m->as.fault.fault = cw_variant(r, CW_FAULTS);
            m->as.fault.board_time_us = cw_u64(r);
            break;
        default:
            m->as.pong.token = cw_u32(r);
            m->as.pong.board_time_us = cw_u64(r);
            break;
        }
    }
    return !reader.bad && reader.at == reader.end;
}

/* What stands between two zeros; false unless every check passes. */
static bool cw_open(cw_direction direction, const uint8_t *encoded, size_t length, cw_message *m) {
    uint8_t body[CW_MAX_ENCODED];
    size_t n = 0;
    for (size_t i = 0; i < length;) {
        size_t code = encoded[i++]; /* never 0 */
        for (size_t k = 1; k < code; k++) {
            if (i == length) return false; /* cut off */
            body[n++] = encoded[i++];
        }
        /* A group shorter than 254 bytes ends in a zero, unless it is the last; longer ones do not fit a frame. */
        if (i < length) body[n++] = 0;
    }
    if (n < 5) return false;
    uint32_t crc = cw_crc32(body, n - 4);
    for (int k = 0; k < 4; k++)
        if (body[n - 4 + (size_t)k] != (uint8_t)(crc >> (8 * k))) return false;
    return body[0] == (uint8_t)direction && cw_read_message(direction, body + 1, n - 5, m);
}

/* Takes a byte; true when it completes a message. Frames that are damaged are dropped and counted. */
static bool cw_push(cw_decoder *d, cw_direction direction, uint8_t byte, cw_message *m) {
    if (byte != 0) {
        if (d->filled < CW_MAX_ENCODED) d->bytes[d->filled++] = byte;
        else d->overlong = true;
        return false;
    }
    size_t length = d->filled;
    bool overlong = d->overlong;
    d->filled = 0;
    d->overlong = false;
    if (length == 0) return false; /* between two frames */
    if (!overlong && cw_open(direction, d->bytes, length, m)) return true;
    if (d->bad_frames != UINT32_MAX) d->bad_frames++;
    return false;
}

/* ---- writing ---- */

typedef struct { uint8_t *at; } cw_writer; /* room for the longest message is the caller's business */

static void cw_put(cw_writer *w, uint8_t byte) { *w->at++ = byte; }

static void cw_put_varint(cw_writer *w, uint64_t value) {
    while (value >= 0x80u) { cw_put(w, (uint8_t)(value | 0x80u)); value >>= 7; }
    cw_put(w, (uint8_t)value);
}

static void cw_put_i32(cw_writer *w, int32_t value) {
    uint32_t bits = (uint32_t)value;
    cw_put_varint(w, (bits << 1) ^ (value < 0 ? 0xffffffffu : 0u));
}

/* Whether an optional field follows; gives the same, so that it stands in the condition under which the field is written. */
static bool cw_put_has(cw_writer *w, bool has) {
    cw_put(w, has);
    return has;
}

static void cw_put_limits(cw_writer *w, const cw_limits *l) {
    cw_put_i32(w, l->low_pm);
    cw_put_i32(w, l->high_pm);
    cw_put_varint(w, l->slew_nm_per_s);
}

static void cw_put_arm(cw_writer *w, const cw_arm *a) {
    cw_put_varint(w, a->session);
    if (cw_put_has(w, a->has_watchdog)) cw_put_varint(w, a->watchdog_ms);
    if (cw_put_has(w, a->has_hold_watchdog)) cw_put_varint(w, a->hold_watchdog_ms);
    if (cw_put_has(w, a->has_park)) cw_put_i32(w, a->park_pm);
    if (cw_put_has(w, a->has_limits)) cw_put_limits(w, &a->limits);
    cw_put(w, a->interpolate);
    cw_put_varint(w, a->status_every);
}

static void cw_put_status(cw_writer *w, const cw_status *s) {
    cw_put_varint(w, s->session);
    if (cw_put_has(w, s->has_last_seq)) cw_put_varint(w, s->last_seq);
    cw_put_varint(w, s->last_time_us);
    cw_put_varint(w, s->state);
    cw_put_i32(w, s->applied_pm);
    cw_put_i32(w, s->neutral_pm);
    cw_put_varint(w, s->board_time_us);
    cw_put_varint(w, s->fault);
    cw_put(w, s->led);
    cw_put_varint(w, s->bad_frames);
    cw_put_varint(w, s->ignored);
    cw_put_varint(w, s->late);
    cw_put_varint(w, s->clipped);
    cw_put_varint(w, s->unsent);
    cw_put_varint(w, s->holds);
}

static void cw_put_identity(cw_writer *w, const cw_identity *i) {
    cw_put_varint(w, i->protocol);
    for (int k = 0; k < 3; k++) cw_put(w, i->firmware[k]);
    cw_put_varint(w, i->serial);
    cw_put_limits(w, &i->limits);
    cw_put_varint(w, i->ramp_nm_per_s);
    cw_put_i32(w, i->park_pm);
    cw_put(w, i->dac_bits);
    cw_put_varint(w, i->watchdog_ms);
    cw_put_varint(w, i->hold_watchdog_ms);
}

static void cw_put_message(cw_writer *w, const cw_message *m) {
    cw_put(w, (uint8_t)(m->kind & 0xff));
    switch (m->kind) {
    case CW_HELLO: cw_put_varint(w, m->as.hello_protocol); break;
    case CW_ARM: cw_put_arm(w, &m->as.arm); break;
    case CW_COMMAND:
        cw_put_varint(w, m->as.command.session);
        cw_put_varint(w, m->as.command.seq);
        cw_put_varint(w, m->as.command.time_us);
        cw_put_i32(w, m->as.command.displacement_pm);
        cw_put_i32(w, m->as.command.neutral_pm);
        break;
    case CW_LED: cw_put(w, m->as.led_on); break;
    case CW_PING: cw_put_varint(w, m->as.ping_token); break;
    case CW_IDENTITY: cw_put_identity(w, &m->as.identity); break;
    case CW_ACK: cw_put(w, m->as.ack_request); break;
    case CW_REFUSED: cw_put(w, m->as.refused.request); cw_put(w, m->as.refused.refusal); break;
    case CW_STATUS: cw_put_status(w, &m->as.status); break;
    case CW_FAULT: cw_put(w, m->as.fault.fault); cw_put_varint(w, m->as.fault.board_time_us); break;
    case CW_PONG: cw_put_varint(w, m->as.pong.token); cw_put_varint(w, m->as.pong.board_time_us); break;
    default: break;
    }
}

/* Writes a message as one frame; returns its length, 0 when `room` is too short. */
static size_t cw_encode(const cw_message *m, uint8_t *out, size_t room) {
    uint8_t body[CW_MAX_BODY];
    cw_writer w = { body + 1 };
    body[0] = (uint8_t)(m->kind >= CW_IDENTITY ? CW_TO_HOST : CW_TO_BOARD);
    cw_put_message(&w, m); /* at most 75 bytes: see docs/board.md */
    size_t length = (size_t)(w.at - body);
    uint32_t crc = cw_crc32(body, length);
    for (int k = 0; k < 4; k++) body[length++] = (uint8_t)(crc >> (8 * k));
    if (room < length + 3) return 0; /* zero, code byte, body, zero */
    size_t n = 0, code_at = 1;
    out[n++] = 0;
    out[n++] = 0;
    uint8_t code = 1;
    for (size_t i = 0; i < length; i++) {
        if (body[i] == 0) {
            out[code_at] = code;
            code_at = n;
            out[n++] = 0;
            code = 1;
        } else {
            out[n++] = body[i];
            code++;
        }
    }
    out[code_at] = code;
    out[n++] = 0;
    return n;
}

#endif
